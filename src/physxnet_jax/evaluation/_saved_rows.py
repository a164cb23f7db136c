"""Rows of measurements on disk, from which an interrupted measurement resumes."""

import dataclasses
import json
import math
import os
import pathlib
import platform
from collections.abc import Sequence
from typing import Any, TypeVar

import jax

from .._environment import processor_name
from ..errors import FormatError, WeightsError
from ..files import check_writable, write_json
from ..models import read_card
from ._method_names import parse_method

Row = TypeVar("Row")

DIGITS = 16
"""Number of digits of the checksums in rows."""


def machine() -> dict[str, Any]:
    """Processor, cores, device and JAX version, as recorded with measured times."""
    return {
        "cpu": processor_name(),
        "cores": os.cpu_count(),
        "device": jax.devices()[0].device_kind,
        "jax": jax.__version__,
    }


def check_rows_file(path: pathlib.Path | None) -> None:
    """Checks before any measurement that rows can be written.

    Raises:
        FormatError: The file isn't a .json file, or can't be created.
    """
    if path is not None:
        if path.suffix != ".json":
            raise FormatError(f"{path}: rows are written as .json.")
        check_writable(path)


def read_rows(path: pathlib.Path | None, row_type: type[Row]) -> list[Row]:
    """Reads the rows that an earlier run wrote; none if there is no file.

    Args:
        path: The file.
        row_type: Dataclass of a row; null is read as NaN.

    Raises:
        FormatError: The file has other contents, is damaged, or has times of another machine.
    """
    if path is None or not path.is_file():
        return []
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        recorded = None if isinstance(data, list) else data.get("machine")
        rows = [
            row_type(**{k: math.nan if v is None else v for k, v in row.items()})
            for row in (data if isinstance(data, list) else data["rows"])
        ]
    except (ValueError, TypeError, LookupError, AttributeError) as error:
        raise FormatError(
            f"{path}: not rows that this command can resume from ({type(error).__name__}). Name"
            " another file, or delete this one."
        ) from None
    if recorded is not None and not _is_this_machine(recorded):
        raise FormatError(
            f"{path}: times of another machine ({recorded}) aren't comparable with this one's"
            f" ({machine()}). Name another file, or delete this one."
        )
    return rows


def recorded_machine(path: pathlib.Path | None) -> dict[str, Any]:
    """The machine recorded with the rows; this machine if none is recorded."""
    if path is None or not path.is_file():
        return machine()
    data = json.loads(path.read_text(encoding="utf-8"))
    return (not isinstance(data, list) and data.get("machine")) or machine()


def save_rows(
    path: pathlib.Path | None, rows: Sequence[Any], recorded: dict[str, Any] | None = None
) -> None:
    """Writes rows for `read_rows`, if there is a file to write.

    Args:
        path: The file.
        rows: Dataclasses.
        recorded: The machine that the times are of, if they must not be mixed with another's.
    """
    if path is not None:
        data = [row_json(r) for r in rows]
        write_json(path, data if recorded is None else {"machine": recorded, "rows": data})


def row_json(row: Any) -> dict[str, Any]:
    """A row for JSON, its numbers with five digits."""
    return {
        k: float(f"{v:.5g}") if isinstance(v, float) else v
        for k, v in dataclasses.asdict(row).items()
    }


def weights_digest(name: str) -> str:
    """Checksum of a network's weights as recorded in rows; empty if there are no such weights."""
    try:
        return str(read_card(str(parse_method(name).weights))["sha256"])[:DIGITS]
    except (WeightsError, LookupError):
        return ""


def _is_this_machine(recorded: dict[str, Any]) -> bool:
    """Whether times are this machine's; older files record only the architecture."""
    here = machine()
    known = (here["cpu"], platform.machine())
    return recorded.get("cpu") in known and {**recorded, "cpu": here["cpu"]} == here
