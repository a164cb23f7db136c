"""Configurations: Python files that define CONFIG."""

import os
import pathlib
import runpy
from typing import TypeVar

from ..errors import PhysXNetError

T = TypeVar("T")


def read_config(path: str | pathlib.Path, kind: type[T]) -> T:
    """Runs a Python file and takes its ``CONFIG``.

    Raises:
        PhysXNetError: No such file, or no CONFIG of this kind in it.
    """
    path = pathlib.Path(path)
    if not path.is_file():
        raise PhysXNetError(f"{path}: no such configuration.")
    try:
        found = runpy.run_path(str(path)).get("CONFIG")
    except Exception as error:
        raise PhysXNetError(f"{path}: {type(error).__name__}: {error}") from error
    if not isinstance(found, kind):
        raise PhysXNetError(
            f"{path}: expected CONFIG = {kind.__name__}(...), got {type(found).__name__}."
        )
    return found


def mocap_folder(named: pathlib.Path | None) -> pathlib.Path:
    """Where the protocol's motion files lie."""
    if named is not None:
        return named
    return pathlib.Path(os.environ.get("PHYSXNET_DATA", "../shared")) / "mocap"
