"""Rows of measurements that a command goes on from."""

import json
import pathlib
from collections.abc import Callable
from typing import Any, TypeVar

from ..errors import FormatError

Row = TypeVar("Row")


def kept_rows(path: pathlib.Path | None, made: Callable[[dict[str, Any]], Row]) -> list[Row]:
    """Rows of a file that such a command wrote; none if there isn't any.

    Raises:
        FormatError: Something else lies there, or what is left of it.
    """
    if path is None or not path.is_file():
        return []
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        return [made(row) for row in (data if isinstance(data, list) else data["rows"])]
    except (ValueError, TypeError, LookupError, AttributeError) as error:
        raise FormatError(
            f"{path}: not rows that this command can go on from ({type(error).__name__}). Name"
            " another file, or delete this one."
        ) from None
