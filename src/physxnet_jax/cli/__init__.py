"""The `physxnet` command: parse, call, print."""

from ._main import main as main, parse as parse
