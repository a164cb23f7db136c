"""Names of joints: families of skeletons, and maps of one's own."""

import pathlib
import tomllib

from ..body import load_body
from ..errors import MotionError
from ._source import SourceClip

_SIDES = (("Left", "l", "L"), ("Right", "r", "R"))
_TRUNK = ("Hips", "LowerBack", "Spine", "Spine1", "Neck", "Neck1", "Head")
_ARM = ("Shoulder", "Arm", "ForeArm", "Hand")
_LEG = ("UpLeg", "Leg", "Foot", "ToeBase")


def _family(
    trunk: tuple[str | None, ...], arm: tuple[str, ...], leg: tuple[str | None, ...]
) -> dict[str, str]:
    """Body joint to source joint; '{S}' is Left or Right, '{l}' left, '{s}' l."""
    out = {b: s for b, s in zip(_TRUNK, trunk, strict=True) if s}
    for side, small, _ in _SIDES:
        for names, sources in ((_ARM, arm), (_LEG, leg)):
            for b, s in zip(names, sources, strict=True):
                if s:
                    out[side + b] = s.format(S=side, s=small, l=side.lower())
    return out


JOINT_MAPS: dict[str, dict[str, str]] = {
    "cmu-asf": _family(
        ("root", "lowerback", "upperback", "thorax", "lowerneck", "upperneck", "head"),
        ("{s}clavicle", "{s}humerus", "{s}radius", "{s}wrist"),
        ("{s}femur", "{s}tibia", "{s}foot", "{s}toes"),
    ),
    "cmu-motionbuilder": _family(
        _TRUNK,
        tuple("{S}" + n for n in _ARM),
        tuple("{S}" + n for n in _LEG),
    ),
    "cmu-daz": _family(
        ("hip", "abdomen", None, "chest", "neck", None, "head"),
        ("{s}Collar", "{s}Shldr", "{s}ForeArm", "{s}Hand"),
        ("{s}Thigh", "{s}Shin", "{s}Foot", None),
    ),
    "cmu-3dsmax": _family(
        ("Hips", "lowerback", "Chest", "Chest2", "lowerneck", "Neck", "Head"),
        ("{S}Collar", "{S}Shoulder", "{S}Elbow", "{S}Wrist"),
        ("{S}Hip", "{S}Knee", "{S}Ankle", "{S}Toe"),
    ),
    "mixamo": _family(
        ("Hips", "Spine", "Spine1", "Spine2", "Neck", None, "Head"),
        tuple("{S}" + n for n in _ARM),
        tuple("{S}" + n for n in _LEG),
    ),
    "lafan": _family(
        ("Hips", "Spine", "Spine1", "Spine2", "Neck", None, "Head"),
        tuple("{S}" + n for n in _ARM),
        ("{S}UpLeg", "{S}Leg", "{S}Foot", "{S}Toe"),
    ),
    "rokoko": _family(
        ("Hips", "Spine1", "Spine2", "Spine4", "Neck", None, "Head"),
        tuple("{S}" + n for n in _ARM),
        ("{S}Thigh", "{S}Shin", "{S}Foot", "{S}Toe"),
    ),
    "smpl": _family(
        ("pelvis", "spine1", "spine2", "spine3", "neck", None, "head"),
        ("{l}_collar", "{l}_shoulder", "{l}_elbow", "{l}_wrist"),
        ("{l}_hip", "{l}_knee", "{l}_ankle", "{l}_foot"),
    ),
}
"""Joint maps by family: body joint to source joint."""

LIMBS = {
    f"{side}{a}": f"{side}{b}"
    for side, _, _ in _SIDES
    for a, b in (("Arm", "ForeArm"), ("ForeArm", "Hand"), ("UpLeg", "Leg"), ("Leg", "Foot"))
}
"""Limb bones: joint at the start, joint at the end."""

NEEDED = frozenset({"Hips", *LIMBS, *LIMBS.values()})
"""Joints without which a person can't be followed."""


def find_joint_map(source: SourceClip) -> tuple[str, dict[str, str]]:
    """The family whose joints the skeleton has, whatever stands before their names.

    Joints that aren't limbs may be missing: they then follow their parents.

    Raises:
        MotionError: If none fits; the text lists what is missing from the nearest.
    """
    have = {name.lower(): name for name in source.names}
    found: dict[str, dict[str, str]] = {}
    for family, joints in JOINT_MAPS.items():
        hips = joints["Hips"].lower()
        prefixes = {name[: -len(hips)] for name in have if name.endswith(hips)} or {""}
        for prefix in sorted(prefixes):
            mapped = {
                b: have[prefix + s.lower()] for b, s in joints.items() if prefix + s.lower() in have
            }
            if len(mapped) > len(found.get(family, {})):
                found[family] = mapped
    missing = {
        family: [s for b, s in joints.items() if b not in found.get(family, {})]
        for family, joints in JOINT_MAPS.items()
    }
    family = min(missing, key=lambda f: (len(NEEDED - found.get(f, {}).keys()), len(missing[f])))
    joints = found.get(family, {})
    if NEEDED - joints.keys():
        needed = [s for b, s in JOINT_MAPS[family].items() if b in NEEDED - joints.keys()]
        lacks = ", ".join(needed[:6])
        raise MotionError.at(
            source.path,
            None,
            f"unknown joints: not one of {', '.join(JOINT_MAPS)}; the nearest,"
            f" {family}, lacks {lacks}",
            "Pass a joint map (--joint-map FILE, joint_map={'Hips': 'your name', …}); the"
            f" file has {', '.join(source.names[:40])}",
        )
    return family, joints


def read_joint_map(path: str | pathlib.Path) -> dict[str, str]:
    """A joint map from a TOML file of lines `Hips = "the file's name"`.

    Args:
        path: The file; its keys are joints of the body.

    Returns:
        Body joint to the file's joint.

    Raises:
        MotionError: Not TOML, not names alone, or joints that the body hasn't.
    """
    path = pathlib.Path(path)
    try:
        if path.stat().st_size > 1_000_000:
            raise MotionError.at(path, None, "over 1 MB", "A joint map is a page of names")
        joints = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise MotionError.at(
            path, None, f"not a joint map ({error})", 'Write lines like Hips = "pelvis"'
        ) from None
    known = load_body().joint_names
    wrong = [k for k, v in joints.items() if k not in known or not isinstance(v, str)]
    if wrong or not joints:
        raise MotionError.at(
            path,
            None,
            f"{', '.join(wrong[:6]) or 'no line'} is no joint of the body with a name",
            f'The body has {", ".join(known)}; write lines like Hips = "pelvis"',
        )
    return joints
