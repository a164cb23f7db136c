"""Metrics: what an answer is worth."""

from ._metrics import VertexError as VertexError, vertex_error as vertex_error
