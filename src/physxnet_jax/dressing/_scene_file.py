"""Scenes from TOML files: motion, garments, effects, accuracy."""

import dataclasses
import pathlib
import tomllib
from collections.abc import Sequence
from typing import Any

from jaxtyping import Array, Float

from ..body import load_body
from ..errors import FormatError
from ..files import is_file
from ..garment import FABRICS, Garment
from ..io import split_part
from ..motion import Motion, sudden_turns
from ..simulation import (
    ACCURACY,
    EFFECTS,
    Air,
    Damping,
    Effect,
    Scene,
    SelfContact,
    standard_effects,
)
from ._layers import inside_out
from ._meshes import Wear, worn_garments
from ._wanted_clip import wanted_clip

# Beyond this a whole number is no setting, and no float either.
_LARGEST = 10**12
_KEYS: dict[str, type | tuple[type, ...]] = {
    "motion": str,
    "source_fps": (int, float),
    "skeleton": str,
    "joint_map": str,
    "fps": (int, float),
    "start": (int, float),
    "frames": int,
    "accuracy": str,
    "garments": list,
    "shape": dict,
    "effects": dict,
    "also": dict,
}


@dataclasses.dataclass(frozen=True)
class SceneFile:
    """A scene with the motion it is simulated through.

    Attributes:
        scene: Garments, effects, shape.
        motion: The body's motion.
        accuracy: ``draft``, ``standard`` or ``fine``.
        notes: What is good to know of the motion, and of garments read from files.
    """

    scene: Scene
    motion: Motion
    accuracy: str = "standard"
    notes: tuple[str, ...] = ()


def make_scene(
    motion: str | pathlib.Path | Motion,
    wear: Wear = ("top", "bottom"),
    *,
    fps: float | None = None,
    source_fps: float | None = None,
    skeleton: str | pathlib.Path | None = None,
    joint_map: str | pathlib.Path | None = None,
    start: float = 0.0,
    frames: int | None = None,
    accuracy: str = "standard",
    fabric: str | None = None,
    shape: Float[Array, " shapes"] | None = None,
    effects: Sequence[Effect] | None = None,
    also: Sequence[Effect] = (),
) -> SceneFile:
    """A scene from names and files.

    Args:
        motion: A motion, a motion file, or the name of a built-in clip.
        wear: Garments, garment files or template names; put into the order of layers.
        fps: Frames a second; a `Motion`'s own if omitted, else 30.
        source_fps: True rate of a motion file [1/s], where its header is wrong or silent.
        skeleton: The ASF of an AMC file, if it doesn't lie beside it.
        joint_map: File of joint names, for a motion file of unknown ones.
        start: Where in the motion to begin [s].
        frames: Keep only this many frames.
        accuracy: ``draft``, ``standard`` or ``fine``.
        fabric: Name of a fabric for all garments; their own if None.
        shape: Shape parameters; the default shape if omitted.
        effects: What acts; `standard_effects` if None.
        also: Effects that act besides those; one of the same kind is replaced.

    Raises:
        PhysXNetError: What can't be read or isn't known; the text says what there is.
    """
    if accuracy not in ACCURACY:
        raise FormatError(f"No accuracy '{accuracy}'; there are {', '.join(ACCURACY)}.")
    if fabric is not None and fabric not in FABRICS:
        raise FormatError(f"No fabric '{fabric}'; there are {', '.join(FABRICS)}.")
    body = load_body()
    clip = wanted_clip(
        motion,
        fps=fps,
        body=body,
        shape=shape,
        start=start,
        frames=frames,
        source_fps=source_fps,
        skeleton=skeleton,
        joint_map=joint_map,
    )
    garments, notes = worn_garments(wear, body)
    if fabric is not None:
        garments = [made_of(g, fabric) for g in garments]
    garments = inside_out(garments)
    acting = standard_effects(len(garments)) if effects is None else tuple(effects)
    if effects is None and any(isinstance(e, Air) for e in also):
        # Damping stands for still air: with both it would be there twice.
        acting = tuple(e for e in acting if not isinstance(e, Damping))
    scene = Scene(tuple(garments), _merged(acting, also), body, shape)
    fault = sudden_turns(body, clip)
    return SceneFile(scene, clip, accuracy, notes if fault is None else (fault, *notes))


def load_scene(path: str | pathlib.Path, *, frames: int | None = None) -> SceneFile:
    """Reads a scene from TOML; files in it are looked for beside it.

    Args:
        path: The file.
        frames: Keep no more frames than this, however many it asks for.

    ::

        motion = "walk"            # a built-in clip or a motion file
        source_fps = 120           # where the file's header is wrong or silent
        skeleton = "02.asf"        # of an AMC file, if it doesn't lie beside it
        joint_map = "names.toml"   # only for a file of unknown joint names
        garments = ["bottom", "top"]
        start = 0.5                # seconds
        frames = 60
        accuracy = "standard"

        [[garments]]               # instead of the list, to choose fabrics
        file = "top"
        fabric = "silk"

        [also.air]                 # besides what `standard_effects` gives
        wind = [0.0, 0.0, 4.0]

        [effects.gravity]          # or every effect that acts, and no other

    Raises:
        FormatError: Not TOML, an unknown key, effect or setting.
    """
    path = pathlib.Path(path)
    if not is_file(path):
        raise FormatError(f"{path}: no such file. Check the path.")
    try:
        with path.open("rb") as file:
            text = tomllib.load(file)
    # TOMLDecodeError is one of ValueError; so are numbers that Python refuses.
    except (ValueError, RecursionError) as error:
        raise FormatError(f"{path}: not a scene in TOML: {error}.") from None
    unknown = sorted(set(text) - set(_KEYS))
    if unknown or "motion" not in text:
        wrong = f"unknown key {unknown[0]}" if unknown else "no key motion"
        raise FormatError(f"{path}: {wrong}; a scene has {', '.join(_KEYS)}.")
    for key, value in text.items():
        huge = isinstance(value, int) and abs(value) > _LARGEST
        if not isinstance(value, _KEYS[key]) or isinstance(value, bool) or huge:
            raise FormatError(f"{path}: {key} can't be {value!r}"[:300] + ".")
    wrong = [k for k, v in text.get("shape", {}).items() if not isinstance(v, int | float)]
    if wrong:
        raise FormatError(f"{path}: shape {wrong[0]} isn't a number.")
    for key in ("fps", "source_fps"):
        if not 0 < float(text.get(key, 30.0)) <= 1e4:
            raise FormatError(f"{path}: {key} is {text[key]}, expected a positive number.")
    words = [
        {"file": g} if isinstance(g, str) else g for g in text.get("garments", ["top", "bottom"])
    ]
    for g in words:
        told = set(g) if isinstance(g, dict) else {str(g)}
        if told - {"file", "fabric"} or not all(isinstance(x, str) for x in g.values()):
            raise FormatError(
                f"{path}: a garment has file and fabric, both names, not {', '.join(told)}."
            )
        if "file" not in g:
            raise FormatError(f"{path}: a garment has no file.")
        if "fabric" in g and g["fabric"] not in FABRICS:
            raise FormatError(f"{path}: no fabric '{g['fabric']}'; there are {', '.join(FABRICS)}.")
    worn, notes = worn_garments([_beside(path, g["file"]) for g in words], load_body())
    garments = [
        made_of(w, g["fabric"]) if "fabric" in g else w for w, g in zip(worn, words, strict=True)
    ]
    made = make_scene(
        _beside(path, text["motion"]),
        garments,
        fps=float(text.get("fps", 30.0)),
        source_fps=text.get("source_fps"),
        skeleton=_beside(path, text["skeleton"]) if "skeleton" in text else None,
        joint_map=_beside(path, text["joint_map"]) if "joint_map" in text else None,
        start=float(text.get("start", 0.0)),
        frames=min((n for n in (frames, text.get("frames")) if n is not None), default=None),
        accuracy=text.get("accuracy", "standard"),
        shape=load_body().shape(**text["shape"]) if "shape" in text else None,
        effects=_effects(path, text["effects"]) if "effects" in text else None,
        also=_effects(path, text.get("also", {})),
    )
    return dataclasses.replace(made, notes=(*made.notes, *notes))


def made_of(garment: Garment, fabric: str) -> Garment:
    """A garment of another fabric, by name.

    It keeps at least the distance from the skin that it was made for: that one depends on
    how coarse its mesh is and on what it lies over, not on the cloth alone.
    """
    cloth = FABRICS[fabric]
    thickness = max(cloth.thickness, garment.fabric.thickness)
    return dataclasses.replace(garment, fabric=dataclasses.replace(cloth, thickness=thickness))


def _beside(path: pathlib.Path, word: str) -> str | pathlib.Path:
    there = path.parent / word
    # A garment may have "#mesh" and "=top" behind it.
    plain = path.parent / (word.rpartition("=")[0] or word)
    files = (there, plain, split_part(there)[0], split_part(plain)[0])
    return there if any(map(is_file, files)) else word


def _effects(path: pathlib.Path, table: dict[str, Any]) -> list[Effect]:
    out = []
    for name, settings in table.items():
        if name not in EFFECTS:
            raise FormatError(f"{path}: no effect '{name}'; there are {', '.join(EFFECTS)}.")
        kind = EFFECTS[name]
        if not isinstance(settings, dict):
            raise FormatError(
                f"{path}: {name} is a table of settings, not {settings!r}"[:300] + "."
            )
        fields = {f.name: f for f in dataclasses.fields(kind)}
        unknown = sorted(set(settings) - set(fields))
        if unknown:
            there = ", ".join(fields) or "no settings"
            raise FormatError(f"{path}: {name} has no '{unknown[0]}'; it has {there}.")
        try:
            out.append(kind(**{k: _value(fields[k], v) for k, v in settings.items()}))
        except (TypeError, ValueError, OverflowError) as error:
            raise FormatError(f"{path}: {name}: {error}"[:300] + ".") from None
    return out


def _value(field: dataclasses.Field, value: Any) -> Any:
    if isinstance(value, list):
        if any(isinstance(v, list) for v in value):
            raise TypeError(f"{field.name} is a list of lists")
        return tuple(_value(field, v) for v in value)
    wants_float = field.type is float or "float" in str(field.type)
    if wants_float and (isinstance(value, bool) or not isinstance(value, int | float)):
        raise TypeError(f"{field.name} is {value!r}, expected a number")
    if field.type is int and (isinstance(value, bool) or not isinstance(value, int)):
        raise TypeError(f"{field.name} is {value!r}, expected a whole number")
    if field.type is bool and not isinstance(value, bool):
        raise TypeError(f"{field.name} is {value!r}, expected true or false")
    return float(value) if isinstance(value, int) and wants_float else value


def _merged(effects: Sequence[Effect], also: Sequence[Effect]) -> tuple[Effect, ...]:
    """Both together, in the order of `EFFECTS`; effects of one's own before all contact."""
    rank = {kind: k for k, kind in enumerate(EFFECTS.values())}
    own = rank[SelfContact] - 0.5
    new = {type(e) for e in also}
    kept = [e for e in effects if type(e) not in new]
    return tuple(sorted((*kept, *also), key=lambda e: rank.get(type(e), own)))
