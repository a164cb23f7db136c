"""Reader of BVH files: any hierarchy, any channel order."""

import collections
import pathlib

import numpy as np
from scipy.spatial.transform import Rotation

from ..errors import MotionError
from ..io import nominal_rate
from ._source import MAX_JOINT_FRAMES, SourceClip
from ._text import is_count, numbers, read_lines, table

_AXES = {"Xrotation": "X", "Yrotation": "Y", "Zrotation": "Z"}
_POSITIONS = {"Xposition": 0, "Yposition": 1, "Zposition": 2}
_MAX_DEPTH = 200


def read_bvh(path: str | pathlib.Path) -> SourceClip:
    """Reads a BVH file, without retargeting.

    If a file has several skeletons, the one with the most joints is read; of several such, the
    first. Repeated names within a skeleton are numbered: ``Hand``, ``Hand_2``.

    Args:
        path: The file.

    Returns:
        Joints, offsets in the file's unit, world rotations and root positions.

    Raises:
        MotionError: Malformed, truncated, empty or binary files, wrong numbers of
            channels or values, or values that aren't finite. The message names file,
            line and fix.

    References:
        Meredith and Maddock, Motion Capture File Formats Explained (2001).
    """
    path = pathlib.Path(path)
    lines = read_lines(path, "BVH")
    joints, motion_line = _read_hierarchy(path, lines)
    names, parents, offsets, channels = joints
    values, fps = _read_motion(path, lines, motion_line, sum(map(len, channels)))
    names, parents, offsets, channels, values = _largest_tree(
        names, parents, offsets, channels, values
    )
    if len(values) * len(names) > MAX_JOINT_FRAMES:
        raise MotionError.at(
            path,
            None,
            f"{len(values):,} frames of {len(names):,} joints are too many",
            "Cut the clip into shorter files",
        )
    root = np.tile(offsets[0], (len(values), 1))
    world = np.zeros((len(values), len(names), 3, 3))
    moves = any(c in _POSITIONS for chans in channels[1:] for c in chans)
    shifts = np.tile(offsets, (len(values), 1, 1)) if moves else None
    at = 0
    for j, chans in enumerate(channels):
        block = values[:, at : at + len(chans)]
        at += len(chans)
        order = "".join(_AXES[c] for c in chans if c in _AXES)
        turns = [k for k, c in enumerate(chans) if c in _AXES]
        local = (
            Rotation.from_euler(order, block[:, turns], degrees=True).as_matrix()
            if order
            else np.broadcast_to(np.eye(3), (len(values), 3, 3))
        )
        for k, c in enumerate(chans):
            if c in _POSITIONS and j == 0:
                root[:, _POSITIONS[c]] = block[:, k]
            elif c in _POSITIONS and shifts is not None:
                shifts[:, j, _POSITIONS[c]] = block[:, k]
        world[:, j] = local if parents[j] < 0 else world[:, parents[j]] @ local
    return SourceClip(
        tuple(names),
        tuple(parents),
        offsets,
        world,
        root,
        fps,
        path.stem,
        str(path),
        shifts=shifts,
    )


def _largest_tree(
    names: list[str],
    parents: list[int],
    offsets: np.ndarray,
    channels: list[list[str]],
    values: np.ndarray,
) -> tuple[list[str], list[int], np.ndarray, list[list[str]], np.ndarray]:
    root = np.arange(len(names))
    for j, parent in enumerate(parents):
        if parent >= 0:
            root[j] = root[parent]
    keep = np.flatnonzero(root == np.bincount(root).argmax())
    owner = np.repeat(np.arange(len(names)), [len(c) for c in channels])
    # The joints of a skeleton are contiguous in the file.
    parents = [parents[j] - int(keep[0]) if parents[j] >= 0 else -1 for j in keep]
    return (
        [names[j] for j in keep],
        parents,
        offsets[keep],
        [channels[j] for j in keep],
        values[:, np.isin(owner, keep)],
    )


def _read_hierarchy(path: pathlib.Path, lines: list[str]) -> tuple[tuple, int]:
    names: list[str] = []
    parents: list[int] = []
    offsets: list[list[float]] = []
    channels: list[list[str]] = []
    stack: list[int] = []
    taken: collections.Counter[str] = collections.Counter()
    pending = end_site = False
    first = next((n for n, line in enumerate(lines) if line.strip()), 0)
    if lines[first].strip().upper() != "HIERARCHY":
        raise MotionError.at(
            path,
            first + 1,
            f"'{lines[first].strip()[:40]}' where HIERARCHY was expected",
            "Is this a BVH file?",
        )
    for n, line in enumerate(lines[first + 1 :], start=first + 2):
        words = line.split()
        if not words:
            continue
        key = words[0]
        if key in ("ROOT", "JOINT"):
            if (key == "JOINT") != bool(stack):
                where = "outside any joint" if key == "JOINT" else "inside a joint"
                raise MotionError.at(path, n, f"a {key} {where}", "Check braces")
            name = " ".join(words[1:]) or f"joint{len(names)}"
            # Some exporters prefix names with a namespace.
            name = name.split(":")[-1]
            if key == "ROOT":
                taken = collections.Counter()
            taken[name] += 1
            if taken[name] > 1:
                while f"{name}_{taken[name]}" in taken:
                    taken[name] += 1
                name = f"{name}_{taken[name]}"
                taken[name] = 1
            names.append(name)
            parents.append(stack[-1] if key == "JOINT" else -1)
            offsets.append([])
            channels.append([])
            pending = True
        elif key == "End":
            pending = end_site = True
        elif key == "{":
            if not pending or len(stack) > _MAX_DEPTH:
                raise MotionError.at(path, n, "an unexpected '{'", "Check the hierarchy")
            stack.append(-2 if end_site else len(names) - 1)
            pending = end_site = False
        elif key == "}":
            if not stack:
                raise MotionError.at(path, n, "an unmatched '}'", "Check the hierarchy")
            stack.pop()
        elif key == "OFFSET":
            xyz = numbers(path, n, words[1:])
            if len(xyz) != 3 or not stack:
                raise MotionError.at(
                    path, n, f"OFFSET has {len(xyz)} values, expected 3", "Export again"
                )
            if stack[-1] >= 0:
                offsets[stack[-1]] = xyz
        elif key == "CHANNELS":
            _add_channels(path, n, words, stack, channels)
        elif key == "MOTION":
            if stack:
                raise MotionError.at(path, n, f"MOTION with {len(stack)} open braces", "Close them")
            if not names:
                raise MotionError.at(path, n, "no ROOT before MOTION", "Export again")
            for name, offset in zip(names, offsets, strict=True):
                if not offset:
                    raise MotionError.at(path, n, f"joint {name} has no OFFSET", "Add one")
            joints = (names, parents, np.asarray(offsets, dtype=np.float64), channels)
            return joints, n
        else:
            raise MotionError.at(
                path, n, f"unknown keyword '{key[:40]}' in the hierarchy", "Export again"
            )
    raise MotionError.at(
        path, len(lines), "the file ends before MOTION", "It is truncated: export again"
    )


def _add_channels(
    path: pathlib.Path,
    n: int,
    words: list[str],
    stack: list[int],
    channels: list[list[str]],
) -> None:
    if not stack or stack[-1] < 0:
        raise MotionError.at(path, n, "CHANNELS outside a joint", "Check the hierarchy")
    names = words[2:]
    if len(words) < 2 or not is_count(words[1]) or int(words[1]) != len(names):
        raise MotionError.at(
            path,
            n,
            f"CHANNELS declares {words[1] if len(words) > 1 else 'nothing'} but lists"
            f" {len(names)} names",
            "Make the number match the list",
        )
    unknown = [c for c in names if c not in _AXES and c not in _POSITIONS]
    if unknown or len(set(names)) != len(names):
        raise MotionError.at(
            path,
            n,
            f"unknown or repeated channel {unknown or names}",
            "Channels are Xposition … Zrotation, each once",
        )
    channels[stack[-1]] = names


def _read_motion(
    path: pathlib.Path, lines: list[str], start: int, width: int
) -> tuple[np.ndarray, float]:
    body = [(n, w) for n, w in enumerate(lines[start:], start + 1) if w.strip()]
    if len(body) < 2 or not body[0][1].strip().startswith("Frames:"):
        raise MotionError.at(
            path, start + 1, "no 'Frames:' after MOTION", "It is truncated: export again"
        )
    count = body[0][1].split(":")[1].split()
    if len(count) != 1 or not is_count(count[0]) or int(count[0]) == 0:
        raise MotionError.at(
            path,
            body[0][0],
            f"'{body[0][1].strip()[:60]}' is not a number of frames",
            "Write the number of motion lines",
        )
    if not " ".join(body[1][1].split()).startswith("Frame Time:"):
        raise MotionError.at(path, body[1][0], "no 'Frame Time:'", "Export again")
    step = numbers(path, body[1][0], body[1][1].split(":")[1].split())
    if len(step) != 1 or step[0] <= 0:
        raise MotionError.at(path, body[1][0], "Frame Time must be positive", "Fix it")
    rows = body[2:]
    if len(rows) > int(count[0]):
        raise MotionError.at(
            path,
            rows[int(count[0])][0],
            f"more lines than the {count[0]} frames declared",
            "Correct 'Frames:'",
        )
    if len(rows) < int(count[0]):
        raise MotionError.at(
            path,
            len(lines),
            f"{len(rows)} frames of the {count[0]} declared",
            "The file is truncated: export again, or correct 'Frames:'",
        )
    for n, row in rows:
        words = row.split()
        if len(words) != width:
            raise MotionError.at(
                path,
                n,
                f"{len(words)} values where the channels need {width}",
                "The line is damaged, or CHANNELS doesn't match: export again",
            )
    values = table(path, lines, [n for n, _ in rows], 0, width)
    # 0.0083333 is meant to be 1/120.
    fps = 1.0 / step[0]
    if not 1.0 <= fps <= 2000.0:
        raise MotionError.at(
            path,
            body[1][0],
            f"a Frame Time of {step[0]} means {fps:.3g} frames per second",
            "Write it in seconds: 0.00833333 for 120 fps",
        )
    return values, nominal_rate(fps)
