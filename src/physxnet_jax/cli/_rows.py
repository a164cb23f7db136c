"""Saved rows of measurements, from which a command resumes."""

import json
import pathlib
from collections.abc import Callable
from typing import Any, TypeVar

from ..errors import FormatError, WeightsError
from ..evaluation import DIGITS, parse_method
from ..files import check_writable
from ..models import read_card
from ._machine import machine, same_machine

Row = TypeVar("Row")


def check_rows_file(path: pathlib.Path | None) -> None:
    """Checks before any measurement that rows can be written.

    Raises:
        FormatError: The file isn't a .json file, or can't be created.
    """
    if path is not None:
        if path.suffix != ".json":
            raise FormatError(f"{path}: rows are written as .json.")
        check_writable(path)


def kept_rows(path: pathlib.Path | None, from_json: Callable[[dict[str, Any]], Row]) -> list[Row]:
    """Reads the rows that an earlier run wrote; none if there is no file.

    Raises:
        FormatError: The file has other contents, is damaged, or has times of another machine.
    """
    if path is None or not path.is_file():
        return []
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        there = None if isinstance(data, list) else data.get("machine")
        rows = [from_json(row) for row in (data if isinstance(data, list) else data["rows"])]
    except (ValueError, TypeError, LookupError, AttributeError) as error:
        raise FormatError(
            f"{path}: not rows that this command can resume from ({type(error).__name__}). Name"
            " another file, or delete this one."
        ) from None
    if there is not None and not same_machine(there):
        raise FormatError(
            f"{path}: times of another machine ({there}) aren't comparable with this one's"
            f" ({machine()}). Name another file, or delete this one."
        )
    return rows


def measured_on(path: pathlib.Path | None) -> dict[str, Any]:
    """The machine recorded with the rows; this machine if none is recorded."""
    if path is None or not path.is_file():
        return machine()
    return json.loads(path.read_text(encoding="utf-8")).get("machine") or machine()


def weights_digest(name: str) -> str:
    """Checksum of a network's weights as recorded in rows; empty if there are no such weights."""
    try:
        return str(read_card(str(parse_method(name).weights))["sha256"])[:DIGITS]
    except (WeightsError, LookupError):
        return ""
