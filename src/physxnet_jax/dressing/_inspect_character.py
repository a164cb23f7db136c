"""Inspection of rigged persons: what a glTF or VRM file with a skin holds, and how to dress it."""

import dataclasses
import pathlib
import shlex

from ..body import load_body, unit_of_person
from ..errors import PhysXNetError
from ..io import GLTF_FORMATS, GltfFile, SourceMesh, read_gltf_still
from ..motion import find_joint_map, inspect_motion, joint_index, read_rig, split_animation

# A mesh that covers this share of the height from foot to head joint is a person's, not cloth.
_WHOLE = 0.85


@dataclasses.dataclass(frozen=True)
class CharacterInspection:
    """Report on a rigged person, from `inspect_character`.

    Attributes:
        path: The file.
        meshes: Names of its skinned meshes.
        vertices: Number of their vertices.
        height: Height in the bind pose, in the file's unit.
        unit: Unit in which this is a person's height; None if no usual unit fits.
        skeleton: Family of the joint names.
        joints: Number of joints.
        carried: Number of body joints that follow one of them.
        saved_in_a_pose: Whether the nodes stand in another pose than the bind pose.
        animations: Names of the animations; the longest is first.
        problems: Faults, one sentence each.
        notes: Harmless remarks, one sentence each.
        command: Command that dresses the person.
    """

    path: str
    meshes: tuple[str, ...]
    vertices: int
    height: float
    unit: str | None
    skeleton: str
    joints: int
    carried: int
    saved_in_a_pose: bool
    animations: tuple[str, ...]
    problems: tuple[str, ...]
    notes: tuple[str, ...]
    command: str

    @property
    def verdict(self) -> str:
        """What the file is, with the command, or a request to fix the problems first."""
        if not self.problems:
            return f"a person, not a garment; dress it: {self.command}"
        return f"a person, not a garment; fix the problems first, then: {self.command}"


def is_character(path: str | pathlib.Path) -> bool:
    """Whether a file is a rigged person: a skin on known joints that covers head and feet.

    Garments exported with an armature have such joints too, but no head.
    """
    path = split_animation(path)[0]
    if path.suffix.lower() not in GLTF_FORMATS or not path.is_file():
        return False
    try:
        file = GltfFile(path)
        if not file.document.skins or not file.document.meshes:
            return False
        rig = read_rig(file)
        index = joint_index(rig.clip, load_body())
        low, high = _span(_skinned(path))
    # Damaged files are reported by whoever reads them.
    except (PhysXNetError, TypeError, ValueError, AttributeError, LookupError):
        return False
    places = rig.clip.positions()[0]
    feet = max(places[index[f"{s}Foot"], 1] for s in ("Left", "Right"))
    head = places[index["Head"], 1] if "Head" in index else places[index["LeftArm"], 1]
    return bool(high > head and low < feet and high - low > _WHOLE * (head - feet))


def _skinned(path: pathlib.Path) -> list[SourceMesh]:
    return [p for p in read_gltf_still(path) if p.bind is not None]


def _span(parts: list[SourceMesh]) -> tuple[float, float]:
    """Lowest and highest coordinate along Y of skinned meshes in the bind pose."""
    y = [p.bind[:, 1] for p in parts if p.bind is not None]
    return (float(min(x.min() for x in y)), float(max(x.max() for x in y))) if y else (0.0, 0.0)


def inspect_character(path: str | pathlib.Path) -> CharacterInspection:
    """Inspects a rigged person without changing the file.

    Args:
        path: A glTF or VRM file with a skin.

    Raises:
        PhysXNetError: It can't be read, has no skin, or its joints are unknown.
    """
    file = split_animation(path)[0]
    document = GltfFile(file)
    rig = read_rig(document)
    family, index = find_joint_map(rig.clip)
    parts = _skinned(file)
    low, high = _span(parts)
    unit = unit_of_person(high - low)
    names = document.animation_names()
    longest = names[document.animation()] if names else None
    problems, notes = [], []
    if unit is None:
        problems.append(f"its height is {high - low:.3g}, which is no person's in any usual unit.")
    if rig.rest is not None:
        notes.append("it was saved in a pose; its bind pose is taken as its rest pose.")
    quoted = shlex.quote(str(path))
    out = f"{file.stem}_dressed.glb"
    drive = f"physxnet dress walk --character {quoted} --wear shirt trousers -o {out}"
    command = drive
    if longest is not None:
        moving = inspect_motion(path)
        problems += moving.problems
        notes += moving.notes
        command = f"physxnet dress {quoted} --animated-body --wear shirt trousers"
        command += f" -o {file.stem}_dressed.usdc"
        notes.append(f"another motion drives it by: {drive}")
    return CharacterInspection(
        path=str(path),
        meshes=tuple(dict.fromkeys(p.name for p in parts)),
        vertices=sum(p.positions.shape[1] for p in parts),
        height=high - low,
        unit=unit,
        skeleton=family,
        joints=len(rig.clip.names),
        carried=len(index),
        saved_in_a_pose=rig.rest is not None,
        animations=() if longest is None else (longest, *(n for n in names if n != longest)),
        problems=tuple(problems),
        notes=tuple(dict.fromkeys(notes)),
        command=command,
    )
