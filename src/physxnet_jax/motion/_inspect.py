"""Inspection of motion files: skeleton, unit, path, and faults that affect the clothes."""

import dataclasses
import pathlib
import shlex
from collections.abc import Mapping
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Array, Float

from ..body import Body, load_body
from ..io import GLTF_FORMATS
from ._faults import slow_subject, sudden_turns
from ._gltf import other_animations, split_animation
from ._load import fitted_motion, read_motion
from ._motion import Motion, resample
from ._procedural import CLIPS
from ._reference import ALWAYS, mean_trunk, reference_pose, upright
from ._retarget import THROUGH, foot_heights, joint_index, leg_length
from ._skeletons import find_joint_map, read_joint_map
from ._source import SourceClip

# Units of length [m]; CMU's lab used a special one.
_UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "inches": 0.0254, "5.6 cm (CMU)": 0.0254 / 0.45}
# Joints of trunk, head and feet; others, such as thumbs, don't affect the cloth.
_CHECKED = ("LowerBack", "Spine", "Spine1", "Neck", "Head", "Shoulder", "ToeBase")
# Largest ratio between the legs' length and the body's at which a unit is recognised.
_MAX_LEG_RATIO = 1.35
# Plausible limits: speed of the hips [m/s]; feet above or below the floor [m].
_MAX_HIP_SPEED, _MAX_FOOT_OFFSET = 12.0, 0.08
# Rate at which motions are checked [1/s]; the networks were trained at it.
_RATE = 30.0


@dataclasses.dataclass(frozen=True)
class MotionInspection:
    """Report on a motion, from `inspect_motion`.

    Attributes:
        path: The file, or the name of a built-in clip.
        frames: Number of frames that drive the body.
        fps: Frame rate [1/s].
        skeleton: Family of the joint names, ``custom map``, or ``built-in body``.
        joints: Number of joints of its skeleton.
        carried: Number of body joints that follow one of them.
        left_out: Body joints of trunk, head and feet that follow their parents instead.
        reference: Reference pose of the rotations.
        unit: Unit of length, inferred from the legs; None if no usual unit fits.
        travelled: Length of the hips' path on the ground [m].
        fastest: Highest speed of the hips [m/s].
        feet: Median height of the lower foot above the floor [m].
        problems: Faults, one sentence each.
        notes: Harmless remarks, one sentence each.
        command: Command that dresses the motion.
    """

    path: str
    frames: int
    fps: float
    skeleton: str
    joints: int
    carried: int
    left_out: tuple[str, ...]
    reference: str
    unit: str | None
    travelled: float
    fastest: float
    feet: float
    problems: tuple[str, ...]
    notes: tuple[str, ...]
    command: str

    @property
    def seconds(self) -> float:
        """Duration [s]."""
        return self.frames / self.fps

    @property
    def verdict(self) -> str:
        """``ready`` and the command, or a request to fix the problems first."""
        if not self.problems:
            return f"ready: {self.command}"
        return f"fix the problems first; to dress it anyway: {self.command}"


def inspect_motion(
    motion: str | pathlib.Path,
    *,
    source_fps: float | int | None = None,
    skeleton: str | pathlib.Path | None = None,
    up: Literal["y", "z"] | None = None,
    joint_map: Mapping[str, str] | str | pathlib.Path | None = None,
    body: Body | None = None,
    shape: Float[Array, " shapes"] | None = None,
) -> MotionInspection:
    """Inspects a motion file without changing it.

    Args:
        motion: As for `load_motion`.
        source_fps: True rate of the file, if its header is wrong or has none [1/s].
        skeleton: The ASF of an AMC file.
        up: Axis of the file that points up, as for `load_motion`.
        joint_map: Body joint to the file's joint, or a TOML file of such pairs.
        body: Body to retarget to; the built-in one by default.
        shape: Its shape parameters.

    Raises:
        MotionError: Unknown name, format or joints, or a file that can't be read.

    Example:
        >>> inspect_motion("walk").problems
        ()
    """
    body = load_body() if body is None else body
    if isinstance(joint_map, str | pathlib.Path):
        mapping, options = read_joint_map(joint_map), ["--joint-map", shlex.quote(str(joint_map))]
    else:
        mapping, options = joint_map, []
    if skeleton is not None:
        options += ["--skeleton", shlex.quote(str(skeleton))]
    if source_fps is not None:
        options += ["--source-fps", f"{source_fps:g}"]
    if up is not None:
        options += ["--up", up]
    read = read_motion(
        motion, source_fps=source_fps, skeleton=skeleton, up=up, body=body, shape=shape
    )
    clip = fitted_motion(read, body, joint_map=mapping, shape=shape)
    rest = body.rest_vertices(body.default_shape() if shape is None else shape)
    found, trajectory = _skeleton(read, mapping, body, rest), _trajectory(body, clip, rest)
    left_out = tuple(n for n in body.joint_names if n not in found.carried and n.endswith(_CHECKED))
    notes = list(trajectory.notes)
    if found.lies:
        notes.append(
            "its trunk points along Z all the time: unless the person is lying, the frames were"
            " written with Z up and the rest pose with Y up; export it again."
        )
    file, animation = split_animation(motion)
    if animation is None and file.suffix.lower() in GLTF_FORMATS:
        chosen, others = other_animations(file)
        if others:
            notes.append(
                f"'{chosen}' is read, the longest of its animations; {motion}#NAME reads"
                f" {', '.join(others)[:200]}."
            )
    if left_out:
        notes.append(f"{', '.join(left_out)} follow their parents: the skeleton lacks them.")
    if found.added:
        notes.append(f"{', '.join(found.added)} are matched by name, not by the joint map.")
    slower = declared_too_fast(motion, read) if mapping is None else None
    if slower is not None:
        notes.append(slower)
    if clip.fps != _RATE and str(motion) not in CLIPS:
        notes.append(
            f"{clip.fps:g} frames per second are resampled to 30; --fps sets another rate."
        )
    out = f"{motion if str(motion) in CLIPS else file.stem}.usdc"
    words = ["physxnet", "dress", shlex.quote(str(motion)), *options]
    words += ["--wear", "shirt", "trousers", "-o", shlex.quote(out)]
    return MotionInspection(
        path=str(motion),
        frames=clip.num_frames,
        fps=clip.fps,
        skeleton=found.family,
        joints=found.joints,
        carried=len(found.carried),
        left_out=left_out,
        reference=found.reference,
        unit=found.unit,
        travelled=trajectory.travelled,
        fastest=trajectory.fastest,
        feet=trajectory.feet,
        problems=tuple(trajectory.problems),
        notes=tuple(notes),
        command=" ".join(words),
    )


def declared_too_fast(path: str | pathlib.Path, read: SourceClip | Motion) -> str | None:
    """A note on files of CMU that declare twice the rate of their capture.

    Args:
        path: The file, named as in CMU's database.
        read: What it contains, on a skeleton whose joints are known.
    """
    subject = slow_subject(path)
    if subject is None or isinstance(read, Motion) or read.fps != 120:
        return None
    if not find_joint_map(read)[0].startswith("cmu"):
        return None
    return (
        f"CMU's subject {subject} was captured at 60 frames per second, but its files"
        " declare 120: pass --source-fps 60."
    )


class _Skeleton(NamedTuple):
    """Joint family, the body joints that follow it, and those the joint map leaves to names."""

    family: str
    joints: int
    carried: frozenset[str]
    added: tuple[str, ...]
    reference: str
    unit: str | None
    lies: bool = False


def _skeleton(
    read: SourceClip | Motion,
    mapping: Mapping[str, str] | None,
    body: Body,
    rest: Float[Array, "all 3"],
) -> _Skeleton:
    if isinstance(read, Motion):
        names = body.joint_names
        return _Skeleton("built-in body", len(names), frozenset(names), (), "its rest pose", "m")
    index = joint_index(read, body, mapping)
    return _Skeleton(
        find_joint_map(read)[0] if mapping is None else "custom map",
        len(read.names),
        frozenset(index),
        () if mapping is None else tuple(sorted(index.keys() - mapping.keys())),
        _reference(read, index),
        _unit(read, index, body, rest),
        bool(mean_trunk(upright(read, index), index)[2] > ALWAYS),
    )


class _Trajectory(NamedTuple):
    """Problems and notes about the person's path, with its length, speed and foot height."""

    problems: list[str]
    notes: list[str]
    travelled: float
    fastest: float
    feet: float


def _trajectory(body: Body, clip: Motion, rest: Float[Array, "all 3"]) -> _Trajectory:
    steady = clip if clip.fps <= _RATE else resample(clip, _RATE)
    steps = np.diff(np.asarray(steady.root, np.float64), axis=0)
    speeds = np.linalg.norm(steps, axis=1) * steady.fps
    fastest = float(speeds.max(initial=0.0))
    heights = foot_heights(body, steady, rest)
    feet, low = float(np.median(heights)), float(heights.min())
    problems, notes = [], []
    # Checked at the rate of dressing: a turn over several frames of a faster file may be sudden.
    turns = sudden_turns(body, steady)
    if turns is not None:
        rate = "" if steady is clip else f" (at {_RATE:g} frames per second)"
        problems.append(turns.partition(": ")[2].removesuffix(".") + f"{rate}.")
    if fastest > _MAX_HIP_SPEED:
        frame = int(speeds.argmax() * clip.fps / steady.fps)
        problems.append(
            f"its hips move at {fastest:.0f} m/s at frame {frame}: a jump in the capture, or a"
            " wrong rate (--source-fps sets the true one)."
        )
    if feet > _MAX_FOOT_OFFSET:
        notes.append(f"its feet are {100 * feet:.0f} cm above the floor half of the time.")
    if low < -THROUGH:
        frame = int(heights.argmin() * clip.fps / steady.fps)
        notes.append(f"a foot is {-100 * low:.0f} cm below the floor at frame {frame}.")
    if clip.num_frames < 2:
        notes.append("a single frame: a pose, not a motion.")
    travelled = float(np.linalg.norm(steps[:, [0, 2]], axis=1).sum())
    return _Trajectory(problems, notes, travelled, fastest, feet)


def _reference(source: SourceClip, index: Mapping[str, int]) -> str:
    turned = upright(source, index)
    return reference_pose(turned, index, turned is not source).kind


def _unit(
    source: SourceClip,
    index: Mapping[str, int],
    body: Body,
    rest: Float[Array, "all 3"],
) -> str | None:
    """The unit in which the legs are about as long as the body's."""
    heads = np.asarray(body.joint_positions(rest)[0], np.float64)
    metres = leg_length(heads, body.joint_names.index)
    length = leg_length(source.positions()[0], index.__getitem__)
    factor = {name: max(m * length / metres, metres / (m * length)) for name, m in _UNITS.items()}
    nearest = min(factor, key=factor.__getitem__)
    return nearest if factor[nearest] < _MAX_LEG_RATIO else None
