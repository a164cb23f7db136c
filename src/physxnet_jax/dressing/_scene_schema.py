"""JSON schema of scene files, made of the settings that the program has."""

import dataclasses
import inspect
import re
import types
import typing
from typing import Any

from ..garment import FABRICS, Fabric
from ..simulation import EFFECTS, PRESETS
from ._scene_file import SCENE_KEYS

_TYPES = {str: "string", int: "integer", float: "number", bool: "boolean"}
_ABOUT = {
    "motion": "a built-in clip or a motion file; paths are relative to the scene file",
    "source_fps": "true frame rate of the motion file [1/s], if its header lacks it or is wrong",
    "up": "axis of the motion file that points up, if it isn't found right",
    "skeleton": "the ASF file of an AMC file, if it is in another folder",
    "joint_map": "file of joint names, for a motion file with unknown ones",
    "fps": "frames per second of the result",
    "start": "start within the motion [s]",
    "frames": "keep only this many frames; all by default",
    "accuracy": "accuracy of the simulation",
    "substeps": "steps a frame at 30 frames per second, in place of those of the accuracy",
    "garments": "garments as for --wear, in any order; or tables of `file`, `fabric` and `pin`",
    "shape": "shape parameters of the body by name (`physxnet clips` lists them)",
    "standard": "whether the standard effects act too",
    "effects": "effects by name, each a table of settings; one replaces a standard one of its kind",
}
_DEFAULTS = {
    "fps": 30.0,
    "start": 0.0,
    "accuracy": "standard",
    "garments": ["trousers", "shirt"],
    "standard": True,
}


def attribute_notes(kind: type) -> dict[str, str]:
    """The descriptions of a dataclass's attributes, from its docstring."""
    text = inspect.getdoc(kind) or ""
    part = text.partition("Attributes:\n")[2].partition("\n\n")[0]
    notes: dict[str, str] = {}
    name = ""
    for line in part.splitlines():
        found = re.match(r" {4}(\w+): (.*)", line)
        if found:
            name = found.group(1)
            notes[name] = found.group(2)
        elif name:
            notes[name] += f" {line.strip()}"
    return notes


def _type(annotation: Any) -> dict[str, Any]:
    if isinstance(annotation, str):
        annotation = {"float": float, "int": int, "bool": bool, "str": str}.get(annotation, str)
    if isinstance(annotation, types.UnionType) or typing.get_origin(annotation) is typing.Union:
        parts = [a for a in typing.get_args(annotation) if a is not type(None)]
        return _type(parts[0])
    if annotation in _TYPES:
        return {"type": _TYPES[annotation]}
    args = typing.get_args(annotation)
    if typing.get_origin(annotation) is tuple and args:
        each = _type(args[0])
        fixed = {"minItems": len(args), "maxItems": len(args)} if args[-1] is not ... else {}
        return {"type": "array", "items": each} | fixed
    return {}


def _table(kind: type) -> dict[str, Any]:
    notes = attribute_notes(kind)
    hints = typing.get_type_hints(kind)
    properties = {}
    for field in dataclasses.fields(kind):
        entry = _type(hints[field.name]) | {"description": notes.get(field.name, "")}
        if field.default not in (dataclasses.MISSING, None):
            plain = field.default
            entry["default"] = list(plain) if isinstance(plain, tuple) else plain
        properties[field.name] = entry
    return {"type": "object", "properties": properties, "additionalProperties": False}


def scene_schema() -> dict[str, Any]:
    """JSON schema (draft 2020-12) of scene files, for editors and other programs.

    Example:
        >>> scene_schema()["properties"]["fps"]["default"]
        30.0
    """
    fabric = _table(Fabric)
    fabric["properties"] = {
        "base": {"enum": list(FABRICS), "description": "fabric of which the other numbers are"},
        **fabric["properties"],
    }
    garment = {
        "type": "object",
        "properties": {
            "file": {"type": "string", "description": "a garment as for --wear"},
            "fabric": {"anyOf": [{"enum": list(FABRICS)}, fabric]},
            "pin": {
                "type": "array",
                "items": {"type": "integer", "minimum": 0},
                "description": "numbers of vertices that move with the skin, besides its own pins",
            },
        },
        "required": ["file"],
        "additionalProperties": False,
    }
    effects = {
        name: _table(kind) | {"description": (inspect.getdoc(kind) or "").partition("\n")[0]}
        for name, kind in EFFECTS.items()
    }
    special: dict[str, dict[str, Any]] = {
        "accuracy": {"enum": list(PRESETS)},
        "up": {"enum": ["y", "z"]},
        "garments": {"type": "array", "items": {"anyOf": [{"type": "string"}, garment]}},
        "shape": {"type": "object", "additionalProperties": {"type": "number"}},
        "effects": {"type": "object", "properties": effects, "additionalProperties": False},
    }
    properties = {}
    for name, kind in SCENE_KEYS.items():
        plain = float if isinstance(kind, tuple) else kind
        entry = special.get(name) or {"type": _TYPES.get(plain, "object")}
        properties[name] = entry | {"description": _ABOUT[name]}
        if name in _DEFAULTS:
            properties[name]["default"] = _DEFAULTS[name]
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "Scene of physxnet_jax",
        "type": "object",
        "properties": properties,
        "required": ["motion"],
        "additionalProperties": False,
    }
