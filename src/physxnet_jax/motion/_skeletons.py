"""Joint names: known families of skeletons, and custom joint maps."""

import pathlib
import re
import tomllib

from ..body import load_body
from ..errors import MotionError
from ..files import add_inputs, is_file
from ._source import SourceClip

_SIDES = (("Left", "l", "L"), ("Right", "r", "R"))
_TRUNK = ("Hips", "LowerBack", "Spine", "Spine1", "Neck", "Neck1", "Head")
_ARM = ("Shoulder", "Arm", "ForeArm", "Hand")
_LEG = ("UpLeg", "Leg", "Foot", "ToeBase")
_MARKS = str.maketrans("", "", " _.-")
_SIDE_BEHIND = re.compile(r"^(?P<rest>.*[a-z0-9])[ _.-](?P<side>l|r|left|right)$", re.IGNORECASE)


def _family(
    trunk: tuple[str | None, ...], arm: tuple[str, ...], leg: tuple[str | None, ...]
) -> dict[str, str]:
    """Body joint to source joint; '{S}' is Left or Right, '{l}' left, '{s}' l, '{B}' L."""
    out = {b: s for b, s in zip(_TRUNK, trunk, strict=True) if s}
    for side, small, big in _SIDES:
        for names, sources in ((_ARM, arm), (_LEG, leg)):
            for b, s in zip(names, sources, strict=True):
                if s:
                    out[side + b] = s.format(S=side, s=small, l=side.lower(), B=big)
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
    # VRM's humanoid bones, which are Unity's.
    "vrm": _family(
        ("hips", "spine", "chest", "upperChest", "neck", None, "head"),
        ("{l}Shoulder", "{l}UpperArm", "{l}LowerArm", "{l}Hand"),
        ("{l}UpperLeg", "{l}LowerLeg", "{l}Foot", "{l}Toes"),
    ),
    "vroid": _family(
        ("C_Hips", "C_Spine", "C_Chest", "C_UpperChest", "C_Neck", None, "C_Head"),
        ("{B}_Shoulder", "{B}_UpperArm", "{B}_LowerArm", "{B}_Hand"),
        ("{B}_UpperLeg", "{B}_LowerLeg", "{B}_Foot", "{B}_ToeBase"),
    ),
    "unreal-5": _family(
        ("pelvis", "spine_01", "spine_03", "spine_05", "neck_01", "neck_02", "head"),
        ("clavicle_{s}", "upperarm_{s}", "lowerarm_{s}", "hand_{s}"),
        ("thigh_{s}", "calf_{s}", "foot_{s}", "ball_{s}"),
    ),
    "unreal-4": _family(
        ("pelvis", "spine_01", "spine_02", "spine_03", "neck_01", None, "head"),
        ("clavicle_{s}", "upperarm_{s}", "lowerarm_{s}", "hand_{s}"),
        ("thigh_{s}", "calf_{s}", "foot_{s}", "ball_{s}"),
    ),
    # Blender's Rigify, including its deformation bones (DEF-).
    "rigify": _family(
        ("spine", *(f"spine.00{n}" for n in range(1, 7))),
        ("shoulder.{B}", "upper_arm.{B}", "forearm.{B}", "hand.{B}"),
        ("thigh.{B}", "shin.{B}", "foot.{B}", "toe.{B}"),
    ),
    "makehuman": _family(
        ("root", "spine05", "spine03", "spine01", "neck01", "neck03", "head"),
        ("clavicle.{B}", "upperarm01.{B}", "lowerarm01.{B}", "wrist.{B}"),
        ("upperleg01.{B}", "lowerleg01.{B}", "foot.{B}", None),
    ),
    # 3ds Max's Character Studio: every name begins with Bip01 or Bip001.
    "biped": _family(
        ("Pelvis", "Spine", "Spine1", "Spine2", "Neck", None, "Head"),
        ("{B} Clavicle", "{B} UpperArm", "{B} Forearm", "{B} Hand"),
        ("{B} Thigh", "{B} Calf", "{B} Foot", "{B} Toe0"),
    ),
    "daz-genesis": _family(
        ("hip", "abdomenLower", "abdomenUpper", "chestUpper", "neckLower", "neckUpper", "head"),
        ("{s}Collar", "{s}ShldrBend", "{s}ForearmBend", "{s}Hand"),
        ("{s}ThighBend", "{s}Shin", "{s}Foot", "{s}Toe"),
    ),
    "daz-genesis-9": _family(
        ("hip", "spine1", "spine2", "spine4", "neck1", "neck2", "head"),
        ("{s}_shoulder", "{s}_upperarm", "{s}_forearm", "{s}_hand"),
        ("{s}_thigh", "{s}_shin", "{s}_foot", "{s}_toes"),
    ),
    "character-creator": _family(
        ("Hip", "Waist", "Spine01", "Spine02", "NeckTwist01", "NeckTwist02", "Head"),
        ("{B}_Clavicle", "{B}_Upperarm", "{B}_Forearm", "{B}_Hand"),
        ("{B}_Thigh", "{B}_Calf", "{B}_Foot", "{B}_ToeBase"),
    ),
    "xsens": _family(
        ("Hips", "Chest", "Chest2", "Chest4", "Neck", None, "Head"),
        ("{S}Collar", "{S}Shoulder", "{S}Elbow", "{S}Wrist"),
        ("{S}Hip", "{S}Knee", "{S}Ankle", "{S}Toe"),
    ),
    "optitrack": _family(
        ("Hip", "Ab", None, "Chest", "Neck", None, "Head"),
        ("{B}Shoulder", "{B}UArm", "{B}FArm", "{B}Hand"),
        ("{B}Thigh", "{B}Shin", "{B}Foot", "{B}Toe"),
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
"""Joints that retargeting requires."""


def find_joint_map(source: SourceClip) -> tuple[str, dict[str, str]]:
    """Finds the family of a skeleton's joint names, whatever prefix they have.

    Case, spaces, dots, dashes and underscores are ignored, since programs change them.
    Joints other than hips and limbs may be missing; the body's then follow their parents.

    Raises:
        MotionError: No family fits; the message lists the joints missing from the nearest.
    """
    family, joints = nearest_joint_map(source)
    if NEEDED - joints.keys():
        needed = [s for b, s in JOINT_MAPS[family].items() if b in NEEDED - joints.keys()]
        lacks = ", ".join(needed[:6])
        raise MotionError.at(
            source.path,
            None,
            f"unknown joints: the nearest of {len(JOINT_MAPS)} known skeletons, {family}, has"
            f" {lacks} as well",
            "Pass a joint map (--joint-map FILE, joint_map={'Hips': 'your name', …}); the"
            f" file has {', '.join(source.names[:40])}",
        )
    return family, joints


def nearest_joint_map(source: SourceClip) -> tuple[str, dict[str, str]]:
    """The family that fits the skeleton best, and the joints of it that the skeleton has."""
    have = {plain: name for name in reversed(source.names) for plain in _spellings(name)}
    found: dict[str, dict[str, str]] = {}
    for family, joints in JOINT_MAPS.items():
        plain = {b: _plain(s) for b, s in joints.items()}
        hips = plain["Hips"]
        prefixes = {name[: -len(hips)] for name in have if name.endswith(hips)} or {""}
        for prefix in sorted(prefixes):
            mapped = {b: have[prefix + s] for b, s in plain.items() if prefix + s in have}
            if len(mapped) > len(found.get(family, {})):
                found[family] = mapped
    missing = {
        family: [s for b, s in joints.items() if b not in found.get(family, {})]
        for family, joints in JOINT_MAPS.items()
    }
    family = min(missing, key=lambda f: (len(NEEDED - found.get(f, {}).keys()), len(missing[f])))
    return family, found.get(family, {})


def _spellings(name: str) -> list[str]:
    """A name without marks, and with a side that stands behind it moved to the front."""
    found = _SIDE_BEHIND.match(name)
    if found is None:
        return [_plain(name)]
    rest, side = _plain(found["rest"]), found["side"].lower()
    # Some families put whole sides in front, others letters; a prefix stays before both.
    head, _, tail = found["rest"].rpartition(":")
    sides = (side[0], "left" if side[0] == "l" else "right")
    turned = (_plain(head) + s + _plain(tail) for s in sides)
    return [*(rest + s for s in sides), *turned]


def _plain(name: str) -> str:
    return name.lower().translate(_MARKS)


def read_joint_map(path: str | pathlib.Path) -> dict[str, str]:
    """Reads a joint map from a TOML file of lines `Hips = "the file's name"`.

    Args:
        path: The file; its keys are body joints.

    Returns:
        Body joint to the file's joint.

    Raises:
        MotionError: Not TOML, values that aren't names, or joints that the body lacks.
    """
    path = pathlib.Path(path)
    if not is_file(path):
        raise MotionError.at(path, None, "no such file", "Check the path")
    add_inputs(path)
    try:
        if path.stat().st_size > 1_000_000:
            raise MotionError.at(path, None, "over 1 MB", "A joint map is a short list of names")
        joints = tomllib.loads(path.read_text(encoding="utf-8"))
    # A ValueError is also raised for invalid paths and for numbers that Python rejects.
    except (OSError, ValueError, RecursionError) as error:
        if isinstance(error, MotionError):
            raise
        raise MotionError.at(
            path, None, f"not a joint map ({error})", 'Write lines like Hips = "pelvis"'
        ) from None
    known = load_body().joint_names
    wrong = [k for k, v in joints.items() if k not in known or not isinstance(v, str)]
    if wrong or not joints:
        raise MotionError.at(
            path,
            None,
            f"{', '.join(wrong[:6]) or 'an empty file'} doesn't map a body joint to a name",
            f'The body has {", ".join(known)}; write lines like Hips = "pelvis"',
        )
    return joints
