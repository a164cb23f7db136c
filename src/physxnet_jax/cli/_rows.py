"""Rows of measurements that a command goes on from."""

import json
import pathlib
from collections.abc import Callable
from typing import Any, TypeVar

from ..dressing import weights_folder
from ..errors import FormatError, WeightsError
from ..evaluation import DIGITS
from ..files import check_writable
from ..io import read_card
from ._machine import machine, same_machine

Row = TypeVar("Row")


def check_rows_file(path: pathlib.Path | None) -> None:
    """Fails, before anything is measured, where rows couldn't be written.

    Raises:
        FormatError: No .json, or a place where nothing can be made.
    """
    if path is not None:
        if path.suffix != ".json":
            raise FormatError(f"{path}: rows are written as .json.")
        check_writable(path)


def kept_rows(path: pathlib.Path | None, made: Callable[[dict[str, Any]], Row]) -> list[Row]:
    """Rows of a file that such a command wrote; none if there isn't any.

    Raises:
        FormatError: Something else lies there, or what is left of it, or times of another
            machine.
    """
    if path is None or not path.is_file():
        return []
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        there = None if isinstance(data, list) else data.get("machine")
        rows = [made(row) for row in (data if isinstance(data, list) else data["rows"])]
    except (ValueError, TypeError, LookupError, AttributeError) as error:
        raise FormatError(
            f"{path}: not rows that this command can go on from ({type(error).__name__}). Name"
            " another file, or delete this one."
        ) from None
    if there is not None and not same_machine(there):
        raise FormatError(
            f"{path}: times of another machine ({there}) don't compare with this one's"
            f" ({machine()}). Name another file, or delete this one."
        )
    return rows


def measured_on(path: pathlib.Path | None) -> dict[str, Any]:
    """The machine of the rows that are there; this one where there are none."""
    if path is None or not path.is_file():
        return machine()
    return json.loads(path.read_text(encoding="utf-8")).get("machine") or machine()


def weights_digest(name: str) -> str:
    """Checksum of a network's weights as it is noted in rows; none of what isn't at hand."""
    try:
        return str(read_card(weights_folder(name.removesuffix("+push")))["sha256"])[:DIGITS]
    except (WeightsError, LookupError):
        return ""
