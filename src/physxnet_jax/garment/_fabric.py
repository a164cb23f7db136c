"""Fabrics by name, by numbers and from files."""

import dataclasses
import pathlib
import tomllib
from collections.abc import Mapping
from typing import Any

from ..errors import FormatError, PhysXNetError
from ..files import add_inputs, is_file
from ._garment import FABRICS, Fabric

# A fabric has ten numbers; other files are refused unread [bytes].
_MOST_BYTES = 100_000


def find_fabric(word: str | pathlib.Path) -> Fabric:
    """A fabric by its name in `FABRICS`, or from a TOML file.

    Args:
        word: The name; or a file that ends in ``.toml``, with attributes of `Fabric` as in
            ``density = 0.2``, and ``base`` for the fabric that has the others, cotton by default.

    Raises:
        FormatError: The file can't be read, or isn't a fabric.
        PhysXNetError: There is no fabric of that name.

    Example:
        >>> find_fabric("silk").density
        0.07
    """
    if str(word) in FABRICS:
        return FABRICS[str(word)]
    path = pathlib.Path(word)
    if path.suffix.lower() != ".toml":
        raise PhysXNetError(
            f"No fabric '{word}'; there are {', '.join(FABRICS)}, and files that end in .toml."
        )
    if not is_file(path):
        raise FormatError(f"{path}: no such file. Check the path.")
    add_inputs(path)
    try:
        size = path.stat().st_size
        text = path.read_text(encoding="utf-8") if size <= _MOST_BYTES else ""
    except OSError as error:
        raise FormatError(f"{path}: {error.strerror or error}.") from None
    except ValueError as error:
        raise FormatError(f"{path}: {error}.") from None
    if size > _MOST_BYTES:
        raise FormatError(f"{path}: too large for a fabric; it has lines like density = 0.2.")
    try:
        return fabric_of(tomllib.loads(text))
    except (ValueError, OverflowError, RecursionError) as error:
        raise FormatError(f"{path}: {error}."[:300]) from None


def fabric_of(settings: str | Mapping[str, Any]) -> Fabric:
    """A fabric by its name, or by numbers.

    Args:
        settings: A name in `FABRICS`, or attributes of `Fabric`; ``base`` names the fabric
            of which the others are taken, cotton by default.

    Raises:
        ValueError: An unknown fabric or attribute, or a value that it can't have.

    Example:
        >>> fabric_of({"base": "jersey", "density": 0.2}).stretch
        400.0
    """
    if isinstance(settings, str):
        settings = {"base": settings}
    numbers = dict(settings)
    base = numbers.pop("base", "cotton")
    if not isinstance(base, str) or base not in FABRICS:
        raise ValueError(f"no fabric '{base}'; there are {', '.join(FABRICS)}")
    known = [f.name for f in dataclasses.fields(Fabric)]
    unknown = sorted(set(numbers) - set(known))
    if unknown:
        raise ValueError(f"a fabric has no '{unknown[0]}'; it has base, {', '.join(known)}")
    for name, value in numbers.items():
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise ValueError(f"fabric: {name} is {value!r}, expected a number")
    return dataclasses.replace(FABRICS[base], **{k: float(v) for k, v in numbers.items()})
