"""Metrics and reports: what an answer is worth, and what holds where it is hard."""

from ._metrics import VertexError as VertexError, vertex_error as vertex_error
from ._stress import CASES as CASES, Finding as Finding, run_case as run_case
