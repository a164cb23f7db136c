"""Scenes, from TOML files or arguments: motion, garments, effects, accuracy."""

import dataclasses
import json
import pathlib
import re
import tomllib
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
from jaxtyping import Array, Float

from ..body import load_body
from ..errors import FormatError, MeshError
from ..files import add_inputs, atomic_write, is_file
from ..garment import (
    FABRICS,
    Garment,
    fabric_of,
    find_fabric,
    parse_wear,
    with_default_fabric,
    with_fabric,
)
from ..io import split_part
from ..motion import Motion, prepare_motion, sudden_turns
from ..simulation import EFFECTS, PRESETS, Accuracy, Effect, Scene
from ._meshes import Wear, resolve_garments
from ._simulate import Simulation, build_scene, with_floor

# Larger integers are never valid settings and may not convert to float.
_MAX_INTEGER = 10**12
SCENE_KEYS: dict[str, type | tuple[type, ...]] = {
    "motion": str,
    "source_fps": (int, float),
    "up": str,
    "skeleton": str,
    "joint_map": str,
    "fps": (int, float),
    "start": (int, float),
    "frames": int,
    "accuracy": str,
    "substeps": int,
    "garments": list,
    "shape": dict,
    "standard": bool,
    "effects": dict,
}
"""Keys of a scene file, and the types of their values."""
GARMENT_KEYS = ("file", "fabric", "pin")
"""Keys of a garment's table."""


@dataclasses.dataclass(frozen=True)
class SceneFile:
    """A scene, with the motion of its simulation.

    Attributes:
        scene: Garments, effects and shape.
        motion: The body's motion.
        accuracy: ``draft``, ``standard``, ``fine`` or ``reference``.
        lists_effects: Whether a file names effects.
        substeps: Steps a frame in place of those of ``accuracy``, see `Simulation`.
        keys: Keys of a scene file that state the motion and the garments; empty if they were
            given as objects.
        notes: Remarks on the motion and on garments read from files.
    """

    scene: Scene
    motion: Motion
    accuracy: Accuracy = "standard"
    notes: tuple[str, ...] = ()
    lists_effects: bool = False
    substeps: int | None = None
    keys: Mapping[str, Any] = dataclasses.field(default_factory=dict)


def write_scene(path: str | pathlib.Path, scene_file: SceneFile, effects: Sequence[Effect]) -> None:
    """Writes a scene file that lists all its effects; `load_scene` reads it.

    Args:
        path: The file (.toml).
        scene_file: A scene made of names and files.
        effects: The effects to write in place of the scene's.

    Raises:
        FormatError: The scene was made of objects in memory.
    """
    if not scene_file.keys:
        raise FormatError("A scene of objects in memory can't be written; name clips and files.")
    keys = {**scene_file.keys, "accuracy": scene_file.accuracy, "standard": False}
    if scene_file.substeps is not None:
        keys["substeps"] = scene_file.substeps
    tables = {k: v for k, v in keys.items() if isinstance(v, dict)}
    lines = [f"{k} = {json.dumps(v)}" for k, v in keys.items() if k not in tables | {"garments": 0}]
    for garment in keys["garments"]:
        lines += ["", "[[garments]]"]
        lines += [f"{k} = {_toml(v)}" for k, v in garment.items()]
    names = {kind: name for name, kind in EFFECTS.items()}
    for name, table in tables.items():
        lines += ["", f"[{name}]", *(f"{k} = {json.dumps(v)}" for k, v in table.items())]
    for e in effects:
        lines += ["", f"[effects.{names[type(e)]}]"]
        for field in dataclasses.fields(e):
            value = getattr(e, field.name)
            if value != field.default and value is not None:
                lines.append(f"{field.name} = {json.dumps(value)}")
    with atomic_write(path) as part:
        part.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _toml(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{k} = {json.dumps(v)}" for k, v in value.items()) + "}"
    return json.dumps(value)


def _scene_keys(
    motion: str | pathlib.Path | Motion, wear: Wear, options: Mapping[str, Any]
) -> dict[str, Any]:
    """Keys of a scene file for names and files, with absolute paths; empty for objects."""
    if isinstance(motion, Motion) or isinstance(wear, Garment):
        return {}
    every = [wear] if isinstance(wear, str | pathlib.Path) else list(wear)
    words = [w for w in every if not isinstance(w, Garment)]
    if len(words) < len(every):
        return {}

    def absolute(word: str | pathlib.Path) -> str:
        name = str(word)
        at = pathlib.Path(split_part(pathlib.Path(name))[0])
        return str(pathlib.Path(name).absolute()) if is_file(at) else name

    garments = []
    for w in words:
        item = parse_wear(w)
        file = item.word(absolute(item.name))
        fabric: Any = item.fabric
        if fabric is not None and fabric not in FABRICS:
            # The scene holds the numbers of a fabric's file.
            numbers = dataclasses.asdict(find_fabric(fabric))
            fabric = {k: v for k, v in numbers.items() if v is not None}
        garments.append({"file": file} | ({"fabric": fabric} if fabric else {}))
    keys = {"motion": absolute(motion), "garments": garments}
    for name, value in options.items():
        if value is not None:
            keys[name] = absolute(value) if isinstance(value, str | pathlib.Path) else value
    return keys


def make_scene(
    motion: str | pathlib.Path | Motion,
    wear: Wear = ("shirt", "trousers"),
    *,
    simulation: Simulation | None = None,
    also: Sequence[Effect] = (),
    fps: float | None = None,
    start: float = 0.0,
    frames: int | None = None,
    source_fps: float | None = None,
    up: Literal["y", "z"] | None = None,
    skeleton: str | pathlib.Path | None = None,
    joint_map: str | pathlib.Path | None = None,
    shape: Float[Array, " shapes"] | None = None,
) -> SceneFile:
    """Makes a scene from names and files.

    Args:
        motion: A motion, a motion file, or the name of a built-in clip.
        wear: Garments, garment files, kinds or templates; sorted into layer order.
        simulation: Accuracy and effects; its other options belong to `run_simulation`.
        also: Additional effects; each replaces an effect of the same type.
        fps: Frames per second; by default that of a `Motion`, else 30.
        start: Start time within the motion [s].
        frames: Keep only this many frames.
        source_fps: True frame rate of a motion file [1/s], if its header lacks it or is wrong.
        up: Axis of a motion file that points up; found from its skeleton if omitted.
        skeleton: The ASF file of an AMC file, if it is in another folder.
        joint_map: File that maps joint names, for a motion file with unknown ones.
        shape: Shape parameters; the default shape if omitted.

    Raises:
        PhysXNetError: A file can't be read or a name is unknown; the message lists the choices.
    """
    simulation = Simulation() if simulation is None else simulation
    body = load_body()
    clip = prepare_motion(
        motion,
        fps=fps,
        body=body,
        shape=shape,
        start=start,
        frames=frames,
        source_fps=source_fps,
        up=up,
        skeleton=skeleton,
        joint_map=joint_map,
    )
    garments, notes = resolve_garments(wear, body, shape)
    simulation = with_floor(simulation, garments, body, shape, clip)
    scene = build_scene(garments, body, shape, simulation, also)
    fault = sudden_turns(body, clip)
    options = {
        "fps": fps,
        "start": start,
        "frames": frames,
        "source_fps": source_fps,
        "up": up,
        "skeleton": skeleton,
        "joint_map": joint_map,
    }
    return SceneFile(
        scene,
        clip,
        simulation.accuracy,
        notes if fault is None else (fault, *notes),
        substeps=simulation.substeps,
        keys={} if shape is not None else _scene_keys(motion, wear, options),
    )


def load_scene(path: str | pathlib.Path, *, frames: int | None = None) -> SceneFile:
    """Reads a scene from TOML; paths in it are relative to its folder.

    Args:
        path: The file.
        frames: Maximum number of frames, which overrides a larger number in the file.

    ::

        motion = "walk"            # a built-in clip or a motion file
        source_fps = 120           # if the file's header lacks the rate or is wrong
        skeleton = "02.asf"        # of an AMC file, if it is in another folder
        joint_map = "names.toml"   # only for a file with unknown joint names
        garments = ["trousers", "shirt"]
        start = 0.5                # seconds
        frames = 60
        accuracy = "standard"
        substeps = 256             # in place of those of the accuracy

        [[garments]]               # instead of the list, to choose fabrics
        file = "shirt"
        fabric = "silk"            # or numbers: {density = 0.15, stretch = 300.0}
        pin = [0, 17]              # vertices that move with the skin, besides its own pins

        [effects.air]              # in addition to the standard ones; alone with standard = false
        wind = [0.0, 0.0, 4.0]

    docs/reference/scene-files.md lists every key with its unit and default.

    Raises:
        FormatError: The file isn't TOML, or has an unknown key, effect or setting.
    """
    path = pathlib.Path(path)
    text, words = _read_scene(path)
    shape = load_body().shape(**text["shape"]) if "shape" in text else None
    places = [_resolve_path(path, g["file"]) for g in words]
    # No command may overwrite what a scene names.
    named = [_resolve_path(path, text["motion"]), *(parse_wear(str(w)).name for w in places)]
    add_inputs(path, *named, *(split_part(pathlib.Path(n))[0] for n in named))
    worn, notes = resolve_garments(places, load_body(), shape)
    try:
        garments = [
            _with_options(garment, table) for garment, table in zip(worn, words, strict=True)
        ]
    except MeshError as error:
        raise FormatError(f"{path}: {error}") from None
    listed = _parse_effects(path, text.get("effects", {}))
    standard = text.get("standard", True)
    scene_file = make_scene(
        _resolve_path(path, text["motion"]),
        garments,
        fps=float(text.get("fps", 30.0)),
        source_fps=text.get("source_fps"),
        skeleton=_resolve_path(path, text["skeleton"]) if "skeleton" in text else None,
        up=text.get("up"),
        joint_map=_resolve_path(path, text["joint_map"]) if "joint_map" in text else None,
        start=float(text.get("start", 0.0)),
        frames=min((n for n in (frames, text.get("frames")) if n is not None), default=None),
        simulation=Simulation(
            accuracy=text.get("accuracy", "standard"),
            substeps=text.get("substeps"),
            effects=None if standard else tuple(listed),
        ),
        shape=shape,
        also=listed if standard else (),
    )
    numbers = [isinstance(g.get("fabric"), dict) for g in words]
    files = [
        with_default_fabric([str(place)], None if n else g.get("fabric"))[0]
        for place, g, n in zip(places, words, numbers, strict=True)
    ]
    options = {
        k: _resolve_path(path, v) if k in ("skeleton", "joint_map") else v
        for k, v in text.items()
        if k in ("fps", "start", "frames", "source_fps", "up", "skeleton", "joint_map", "shape")
    }
    keys = _scene_keys(_resolve_path(path, text["motion"]), files, options)
    for entry, g, n in zip(keys["garments"], words, numbers, strict=True):
        entry |= {"fabric": g["fabric"]} if n else {}
        entry |= {"pin": g["pin"]} if "pin" in g else {}
    return dataclasses.replace(
        scene_file,
        keys=keys,
        notes=(*scene_file.notes, *notes),
        lists_effects=bool(listed),
    )


def _with_options(garment: Garment, table: dict[str, Any]) -> Garment:
    """A garment with the fabric and the pins of its table."""
    if "fabric" in table:
        garment = with_fabric(garment, fabric_of(table["fabric"]))
    return garment.with_pins(np.asarray(table["pin"], np.int64)) if "pin" in table else garment


def _read_scene(path: pathlib.Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """The checked keys of a scene file, and its garments as tables."""
    if not is_file(path):
        raise FormatError(f"{path}: no such file. Check the path.")
    try:
        with path.open("rb") as file:
            text = tomllib.load(file)
    # TOMLDecodeError is a ValueError; Python also raises ValueError for numbers it refuses.
    except (ValueError, RecursionError) as error:
        raise FormatError(f"{path}: not a scene in TOML: {error}.") from None
    unknown = sorted(set(text) - set(SCENE_KEYS))
    if unknown or "motion" not in text:
        wrong = f"unknown key {unknown[0]}" if unknown else "no key motion"
        raise FormatError(f"{path}: {wrong}; a scene has {', '.join(SCENE_KEYS)}.")
    for key, value in text.items():
        huge = isinstance(value, int) and abs(value) > _MAX_INTEGER
        misplaced = isinstance(value, bool) and SCENE_KEYS[key] is not bool
        if not isinstance(value, SCENE_KEYS[key]) or misplaced or huge:
            raise FormatError(f"{path}: {key} can't be {value!r}"[:300] + ".")
    wrong = [k for k, v in text.get("shape", {}).items() if not isinstance(v, int | float)]
    if wrong:
        raise FormatError(f"{path}: shape {wrong[0]} isn't a number.")
    for key in ("fps", "source_fps"):
        if not 0 < float(text.get(key, 30.0)) <= 1e4:
            raise FormatError(f"{path}: {key} is {text[key]}, expected a positive number.")
    if text.get("substeps", 1) < 1:
        raise FormatError(f"{path}: substeps is {text['substeps']}, expected a positive number.")
    if text.get("up") not in (None, "y", "z"):
        raise FormatError(f"{path}: up is y or z.")
    if text.get("accuracy", "standard") not in PRESETS:
        raise FormatError(f"{path}: accuracy is one of {', '.join(PRESETS)}.")
    words = [
        {"file": g} if isinstance(g, str) else g
        for g in text.get("garments", ["trousers", "shirt"])
    ]
    for g in words:
        keys = set(g) if isinstance(g, dict) else {str(g)}
        unknown = sorted(keys - set(GARMENT_KEYS))
        if unknown or not isinstance(g.get("file", ""), str):
            known = f"{', '.join(GARMENT_KEYS[:-1])} and {GARMENT_KEYS[-1]}"
            wrong = ", ".join(unknown or sorted(keys))
            raise FormatError(f"{path}: a garment takes {known}, not {wrong}.")
        pins = g.get("pin", [])
        if not isinstance(pins, list) or not all(type(n) is int and 0 <= n < 2**31 for n in pins):
            raise FormatError(f"{path}: pin is a list of vertex numbers, the first of which is 0.")
        if "file" not in g:
            raise FormatError(f"{path}: a garment has no file.")
        if "fabric" in g:
            try:
                fabric_of(g["fabric"])
            except (TypeError, ValueError) as error:
                raise FormatError(f"{path}: {error}"[:300] + ".") from None
    return text, words


def _resolve_path(path: pathlib.Path, word: str) -> str | pathlib.Path:
    def found(option: re.Match[str]) -> str:
        file = path.parent / option[2]
        return f"{option[1]}={file if is_file(file) else option[2]}"

    # Files that a garment's options name.
    word = re.sub(r"(?<=[:,])(fabric|made_on)=([^,]*)", found, word)
    there = path.parent / word
    # A garment's path may be followed by "#mesh" and options.
    files = (path.parent / name for name in (word, parse_wear(word).name))
    return there if any(is_file(split_part(f)[0]) or is_file(f) for f in files) else word


def _parse_effects(path: pathlib.Path, table: dict[str, Any]) -> list[Effect]:
    out = []
    for name, settings in table.items():
        if name not in EFFECTS:
            raise FormatError(f"{path}: no effect '{name}'; there are {', '.join(EFFECTS)}.")
        kind = EFFECTS[name]
        if not isinstance(settings, dict):
            raise FormatError(
                f"{path}: {name} must be a table of settings, not {settings!r}"[:300] + "."
            )
        fields = {f.name: f for f in dataclasses.fields(kind)}
        unknown = sorted(set(settings) - set(fields))
        if unknown:
            there = ", ".join(fields) or "no settings"
            raise FormatError(f"{path}: {name} has no '{unknown[0]}'; it has {there}.")
        try:
            out.append(kind(**{k: _convert_setting(fields[k], v) for k, v in settings.items()}))
        except (TypeError, ValueError, OverflowError) as error:
            raise FormatError(f"{path}: {name}: {error}"[:300] + ".") from None
    return out


def _convert_setting(field: dataclasses.Field, value: Any, within: bool = False) -> Any:
    if isinstance(value, list):
        nested = str(field.type).startswith("tuple[tuple[")
        if any(isinstance(v, list) != (nested and not within) for v in value):
            raise TypeError(f"{field.name} is {'' if nested else 'not '}a list of lists")
        return tuple(_convert_setting(field, v, within=True) for v in value)
    wants_float = field.type is float or "float" in str(field.type)
    if wants_float and (isinstance(value, bool) or not isinstance(value, int | float)):
        raise TypeError(f"{field.name} is {value!r}, expected a number")
    wants_int = field.type is int or re.search(r"\bint\b", str(field.type)) is not None
    if wants_int and (isinstance(value, bool) or not isinstance(value, int)):
        raise TypeError(f"{field.name} is {value!r}, expected a whole number")
    if field.type is bool and not isinstance(value, bool):
        raise TypeError(f"{field.name} is {value!r}, expected true or false")
    return float(value) if isinstance(value, int) and wants_float else value
