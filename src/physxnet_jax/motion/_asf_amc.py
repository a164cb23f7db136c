"""Reader of Acclaim skeleton and motion files (ASF/AMC), CMU's original format."""

import dataclasses
import pathlib
import re

import numpy as np
from scipy.spatial.transform import Rotation

from ..errors import MotionError
from ..files import is_file
from ._source import MAX_JOINT_FRAMES, SourceClip
from ._text import is_count, numbers, read_lines, table

# CMU's files carry no rate; the database was captured at 120 Hz.
CMU_FPS = 120.0
_DOFS = {"rx": 0, "ry": 1, "rz": 2}


@dataclasses.dataclass
class _Bone:
    name: str = ""
    direction: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(3))
    length: float = 0.0
    axis: Rotation = dataclasses.field(default_factory=Rotation.identity)
    order: str = "xyz"
    dof: list[str] = dataclasses.field(default_factory=list)


def find_skeleton(path: pathlib.Path) -> pathlib.Path:
    """Finds the ASF of an AMC in its folder, by name or subject number, or as the only one.

    Raises:
        MotionError: No ASF matches, and the folder doesn't hold exactly one.
    """
    stems = [path.stem, path.stem.split("_")[0], re.sub(r"\d+$", "", path.stem)]
    for stem in stems:
        for suffix in (".asf", ".ASF"):
            candidate = path.with_name(stem + suffix)
            if stem and is_file(candidate):
                return candidate
    found = sorted(path.parent.glob("*.asf"))
    if len(found) == 1:
        return found[0]
    raise MotionError.at(
        path,
        None,
        f"no skeleton: looked for {', '.join(sorted({s + '.asf' for s in stems if s}))}",
        "Put the subject's ASF into its folder or pass it (--skeleton FILE, skeleton=…)",
    )


def read_amc(path: str | pathlib.Path, skeleton: str | pathlib.Path | None = None) -> SourceClip:
    """Reads an AMC file with its ASF skeleton, without retargeting.

    Args:
        path: The AMC.
        skeleton: The ASF; looked up in the AMC's folder if omitted (see `find_skeleton`).

    Returns:
        One joint per bone, at the bone's start, with the bone's world rotation.

    Raises:
        MotionError: Malformed, truncated, empty or binary files, bones that the
            skeleton lacks, or wrong numbers of values. The message names file, line
            and fix.

    References:
        Lander, Working with Motion Capture File Formats (1998): the axis convention.
    """
    path = pathlib.Path(path)
    asf = pathlib.Path(skeleton) if skeleton is not None else None
    lines = read_lines(path, "AMC")
    bones, links, degrees = _read_asf(asf or find_skeleton(path))
    frames = _read_frames(path, lines, bones)
    names = ["root"]
    parents = [-1]
    queue = ["root"]
    while queue:
        parent = queue.pop(0)
        for child in links.get(parent, []):
            if child in names or child not in bones:
                raise MotionError.at(
                    asf or find_skeleton(path),
                    None,
                    f"bone '{child}' is unknown or in a cycle",
                    "Repair :hierarchy",
                )
            names.append(child)
            parents.append(names.index(parent))
            queue.append(child)
    count = len(next(iter(frames.values())))
    if count * len(names) > MAX_JOINT_FRAMES:
        raise MotionError.at(
            path,
            None,
            f"{count:,} frames of {len(names):,} bones are too many",
            "Cut the clip into shorter files",
        )
    world = np.zeros((count, len(names), 3, 3))
    offsets = np.zeros((len(names), 3))
    for j, name in enumerate(names):
        bone = bones[name]
        angles = np.zeros((count, 3))
        if name in frames:
            for k, dof in enumerate(bone.dof):
                if dof in _DOFS:
                    angles[:, _DOFS[dof]] = frames[name][:, k]
        pick = ["xyz".index(c) for c in bone.order]
        turn = Rotation.from_euler(bone.order, angles[:, pick], degrees=degrees)
        local = (bone.axis * turn * bone.axis.inv()).as_matrix()
        if parents[j] < 0:
            world[:, j] = local
        else:
            up = bones[names[parents[j]]]
            offsets[j] = up.direction * up.length
            world[:, j] = world[:, parents[j]] @ local
    places = [bones["root"].dof.index(t) for t in ("tx", "ty", "tz")]
    root = frames["root"][:, places]
    return SourceClip(
        tuple(names), tuple(parents), offsets, world, root, CMU_FPS, path.stem, str(path)
    )


def _read_asf(
    path: pathlib.Path,
) -> tuple[dict[str, _Bone], dict[str, list[str]], bool]:
    lines = read_lines(path, "ASF")
    bones: dict[str, _Bone] = {}
    links: dict[str, list[str]] = {}
    degrees = True
    section = ""
    bone: _Bone | None = None
    root = _Bone(name="root", dof=["tx", "ty", "tz", "rx", "ry", "rz"])
    for n, line in enumerate(lines, start=1):
        words = line.split("#")[0].split()
        if not words:
            continue
        key = words[0].lower()
        if key.startswith(":"):
            section = key[1:]
        elif section == "units" and key == "angle":
            degrees = not "".join(words[1:2]).lower().startswith("rad")
        elif section == "root":
            if key == "order":
                root.dof = [w.lower() for w in words[1:]]
            elif key == "axis":
                root.order = "".join(words[1:2]).lower()
                if sorted(root.order) != ["x", "y", "z"]:
                    raise MotionError.at(path, n, f"root axis '{root.order}'", "Use XYZ")
        elif section == "bonedata":
            if key == "begin":
                bone = _Bone()
            elif bone is None:
                raise MotionError.at(path, n, f"'{key}' outside begin/end", "Repair it")
            elif key == "end":
                if not bone.name:
                    raise MotionError.at(path, n, "a bone without a name", "Name it")
                bones[bone.name] = bone
                bone = None
            elif key == "name":
                bone.name = words[1].lower() if len(words) > 1 else ""
            elif key == "direction":
                bone.direction = np.asarray(_exactly(path, n, words[1:4], 3))
            elif key == "length":
                bone.length = _exactly(path, n, words[1:2], 1)[0]
            elif key == "axis":
                angles = np.asarray(_exactly(path, n, words[1:4], 3))
                bone.order = words[4].lower() if len(words) > 4 else "xyz"
                if sorted(bone.order) != ["x", "y", "z"]:
                    raise MotionError.at(path, n, f"axis order '{words[4]}'", "Use XYZ")
                pick = ["xyz".index(c) for c in bone.order]
                bone.axis = Rotation.from_euler(bone.order, angles[pick], degrees=degrees)
            elif key == "dof":
                bone.dof = [w.lower() for w in words[1:]]
                known = {*_DOFS, "tx", "ty", "tz", "l"}
                if set(bone.dof) - known or len(set(bone.dof)) != len(bone.dof):
                    raise MotionError.at(
                        path, n, f"unknown or repeated dof {bone.dof}", "Use rx ry rz"
                    )
        elif section == "hierarchy" and key not in ("begin", "end"):
            links[words[0].lower()] = [w.lower() for w in words[1:]]
    if not bones or "root" not in links:
        raise MotionError.at(
            path, len(lines), "no :bonedata or no :hierarchy", "The skeleton is truncated"
        )
    if sorted(root.dof) != sorted(["tx", "ty", "tz", "rx", "ry", "rz"]):
        raise MotionError.at(path, None, f"root order {root.dof}", "Six dofs are needed")
    bones["root"] = root
    return bones, links, degrees


def _exactly(path: pathlib.Path, n: int, words: list[str], count: int) -> list[float]:
    out = numbers(path, n, words)
    if len(out) != count:
        raise MotionError.at(path, n, f"{len(out)} values, expected {count}", "Repair it")
    return out


def _read_frames(
    path: pathlib.Path, lines: list[str], bones: dict[str, _Bone]
) -> dict[str, np.ndarray]:
    moving = [name for name, bone in bones.items() if bone.dof]
    # Line numbers per bone: splitting the lines twice avoids holding all words in memory.
    rows: dict[str, list[int]] = {name: [] for name in moving}
    frame = 0
    first: int | None = None
    for n, line in enumerate(lines, start=1):
        words = line.split()
        if not words or words[0][0] in "#:":
            continue
        if len(words) == 1 and is_count(words[0].removeprefix("-")):
            _check_complete(path, n, rows, frame)
            frame += 1
            if first is None:
                first = int(words[0])
            if int(words[0]) != first + frame - 1:
                raise MotionError.at(
                    path,
                    n,
                    f"frame {words[0]} where {first + frame - 1} was expected",
                    "Frames are missing: export the clip again",
                )
            continue
        name = words[0].lower()
        if frame == 0:
            raise MotionError.at(
                path,
                n,
                f"'{words[0][:40]}' before the first frame number",
                "Is this an AMC file?",
            )
        if name not in bones or name not in rows:
            raise MotionError.at(
                path,
                n,
                f"unknown bone '{words[0][:40]}'",
                "The skeleton belongs to another file: pass the right ASF",
            )
        if len(words) - 1 != len(bones[name].dof):
            raise MotionError.at(
                path,
                n,
                f"{len(words) - 1} values for '{name}', the skeleton has"
                f" {len(bones[name].dof)} channels",
                "The line is damaged, or the ASF belongs to another subject",
            )
        rows[name].append(n)
        if len(rows[name]) > frame:
            raise MotionError.at(path, n, f"'{name}' twice in frame {frame}", "Repair it")
    if frame == 0:
        raise MotionError.at(path, len(lines), "no frames in the file", "Export it again")
    _check_complete(path, len(lines), rows, frame)
    return {
        name: table(path, lines, where, 1, len(bones[name].dof))
        for name, where in rows.items()
        if where
    }


def _check_complete(path: pathlib.Path, n: int, rows: dict[str, list[int]], frame: int) -> None:
    """Raises unless every frame so far has the root and each bone that has any values."""
    for name, values in rows.items():
        if len(values) != frame and (values or name == "root"):
            raise MotionError.at(
                path,
                n,
                f"frame {frame} lacks '{name}'",
                "The file is truncated or damaged there: cut that frame off",
            )
