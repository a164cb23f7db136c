"""Configurations: tables of TOML files, read into frozen dataclasses."""

import dataclasses
import os
import pathlib
import tomllib
import types
import typing
from typing import Any, Literal, TypeVar, Union

from ..errors import PhysXNetError

T = TypeVar("T")


def read_config(word: str | pathlib.Path, kind: type[T]) -> T:
    """Reads ``FILE.toml`` or ``FILE.toml#TABLE`` as a dataclass.

    Missing keys are taken from the table named by ``base``, then from the dataclass's
    defaults.

    Args:
        word: The file, optionally with the name of a table in it.
        kind: The dataclass.

    Raises:
        PhysXNetError: No such file or table, an unknown key, or a value of another type.
    """
    file, _, name = str(word).partition("#")
    path = pathlib.Path(file)
    if not path.is_file():
        raise PhysXNetError(f"{path}: no such configuration.")
    try:
        with path.open("rb") as stream:
            tables = tomllib.load(stream)
    except (ValueError, RecursionError) as error:
        raise PhysXNetError(f"{path}: not TOML: {error}.") from None
    table = _table(word, tables, name, ()) if name else tables
    try:
        return _build(kind, table)
    except (TypeError, ValueError, PhysXNetError) as error:
        raise PhysXNetError(f"{word}: {error}") from None


def config_name(word: str | pathlib.Path) -> str:
    """The table's name, or the file's if no table is named."""
    file, _, name = str(word).partition("#")
    return name or pathlib.Path(file).stem


def mocap_folder(named: pathlib.Path | None) -> pathlib.Path:
    """The folder of the protocol's motion files."""
    if named is not None:
        return named
    return pathlib.Path(os.environ.get("PHYSXNET_DATA", "../shared")) / "mocap"


def _table(
    word: str | pathlib.Path, tables: dict[str, Any], name: str, seen: tuple[str, ...]
) -> dict[str, Any]:
    """A table merged over the one that its ``base`` names."""
    found = tables.get(name)
    if not isinstance(found, dict):
        there = ", ".join(k for k, v in tables.items() if isinstance(v, dict))
        raise PhysXNetError(f"{word}: no table '{name}'; there are {there or 'none'}.")
    if "base" not in found:
        return found
    if name in seen:
        raise PhysXNetError(f"{word}: bases {' -> '.join((*seen, name))} form a cycle.")
    base = _table(word, tables, str(found["base"]), (*seen, name))
    return base | {k: v for k, v in found.items() if k != "base"}


def _build(kind: type[T], table: dict[str, Any]) -> T:
    hints = typing.get_type_hints(kind)
    fields = {f.name for f in dataclasses.fields(kind)}  # pyright: ignore[reportArgumentType]
    unknown = sorted(set(table) - fields)
    if unknown:
        raise PhysXNetError(f"unknown key '{unknown[0]}'; there are {', '.join(sorted(fields))}.")
    return kind(**{key: _value(key, hints[key], value) for key, value in table.items()})


def _value(key: str, hint: Any, value: Any) -> Any:
    origin, parts = typing.get_origin(hint), typing.get_args(hint)
    if dataclasses.is_dataclass(hint) and isinstance(value, dict):
        return _build(hint, value)  # pyright: ignore[reportArgumentType]
    if origin is Literal and value in parts:
        return value
    if origin is tuple and isinstance(value, list):
        return tuple(_value(key, parts[0], v) for v in value)
    if origin in (Union, types.UnionType):
        for part in parts:
            try:
                return _value(key, part, value)
            except TypeError:
                continue
    if hint is float and isinstance(value, int | float) and not isinstance(value, bool):
        return float(value)
    if isinstance(hint, type) and type(value) is hint:
        return value
    expected = ", ".join(map(str, parts)) if origin is Literal else getattr(hint, "__name__", hint)
    raise TypeError(f"{key} is {value!r}, expected {expected}")
