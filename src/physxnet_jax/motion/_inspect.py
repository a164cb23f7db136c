"""What a motion file is like, and what clothes will show of it."""

import dataclasses
import pathlib
import shlex
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float

from ..body import Body, load_body
from ._faults import sudden_turns
from ._load import fitted_motion, read_motion
from ._motion import Motion, resample
from ._procedural import CLIPS
from ._reference import ALWAYS, mean_trunk, reference_pose, stands, upright
from ._retarget import foot_heights, joint_index, leg_length
from ._skeletons import find_joint_map, read_joint_map
from ._source import SourceClip

# Units of length by how many metres they are; CMU's lab has one of its own.
_UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "inches": 0.0254, "5.6 cm, CMU's": 0.0254 / 0.45}
# What bends the trunk, the head and the feet: cloth doesn't feel thumbs.
_FELT = ("LowerBack", "Spine", "Spine1", "Neck", "Head", "Shoulder", "ToeBase")
# Subjects of CMU whose conversions say 120 frames a second and have 60.
_SLOW_SUBJECTS = ("60", "61")
# How far a leg may be from the body's for its unit to be told, as a factor.
_ALIKE = 1.35
# Nobody's hips go faster [m/s]; the lower foot's median height is less [m].
_FASTEST, _ABOVE = 12.0, 0.08
# Rate at which people are looked at [1/s]; networks learned from it.
_RATE = 30.0


@dataclasses.dataclass(frozen=True)
class MotionInspection:
    """What was found out about a motion.

    Attributes:
        path: The file, or the name of a built-in clip.
        frames: Frames of the file that move the body.
        fps: Frames a second [1/s].
        skeleton: The family of its joints' names, ``own map``, or ``built-in body``.
        joints: How many joints it has.
        carried: How many of the body's joints follow one of them.
        left_out: Joints of trunk, head and feet that follow their parents instead.
        reference: The pose that its rotations are taken from.
        unit: Its unit by the length of its legs; None if it is none of the usual ones.
        travelled: Length of the hips' way on the ground [m].
        fastest: Highest speed of the hips [m/s].
        feet: Median height of the lower foot above the floor [m].
        problems: What is wrong, a sentence each.
        notes: What is good to know but harms nothing.
        command: The command that dresses it.
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
        """How long it lasts [s]."""
        return self.frames / self.fps

    @property
    def verdict(self) -> str:
        """``ready``, or what to look at first."""
        if not self.problems:
            return f"ready: {self.command}"
        return f"look at what is wrong first; as it is: {self.command}"


def inspect_motion(
    motion: str | pathlib.Path,
    *,
    source_fps: float | int | None = None,
    skeleton: str | pathlib.Path | None = None,
    joint_map: Mapping[str, str] | str | pathlib.Path | None = None,
    body: Body | None = None,
    shape: Float[Array, " shapes"] | None = None,
) -> MotionInspection:
    """Looks at a motion file and changes nothing.

    Args:
        motion: What `load_motion` reads.
        source_fps: True rate of the file, where its header is wrong or silent [1/s].
        skeleton: The ASF of an AMC file.
        joint_map: Body joint to the file's joint, or a file of them.
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
        told, options = read_joint_map(joint_map), ["--joint-map", shlex.quote(str(joint_map))]
    else:
        told, options = joint_map, []
    if skeleton is not None:
        options += ["--skeleton", shlex.quote(str(skeleton))]
    if source_fps is not None:
        options += ["--source-fps", f"{source_fps:g}"]
    read = read_motion(motion, source_fps=source_fps, skeleton=skeleton, body=body, shape=shape)
    clip = fitted_motion(read, body, joint_map=told, shape=shape)
    rest = body.rest_vertices(body.default_shape() if shape is None else shape)
    found, course = _skeleton(read, told, body, rest), _course(body, clip, rest)
    left_out = tuple(n for n in body.joint_names if n not in found.carried and n.endswith(_FELT))
    notes = list(course.notes)
    if found.lies:
        notes.append(
            "its trunk points along Z all the time: if nobody lies there, its frames were written"
            " with Z up and its rest pose with Y up; export it anew."
        )
    if left_out:
        notes.append(f"{', '.join(left_out)} follow their parents: the skeleton has no such joint.")
    if found.added:
        notes.append(f"{', '.join(found.added)} are taken from names that are known.")
    subject = pathlib.Path(str(motion)).stem.partition("_")[0].lstrip("0")
    if subject in _SLOW_SUBJECTS and clip.fps == 120 and found.family.startswith("cmu"):
        notes.append(
            f"CMU's subject {subject} was captured at 60 frames a second, whatever files say:"
            " --source-fps 60."
        )
    if clip.fps != _RATE and str(motion) not in CLIPS:
        notes.append(f"{clip.fps:g} frames a second become 30; --fps says another rate.")
    out = f"{motion if str(motion) in CLIPS else pathlib.Path(motion).stem}.usdc"
    words = ["physxnet", "dress", shlex.quote(str(motion)), *options]
    words += ["--wear", "top", "bottom", "-o", shlex.quote(out)]
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
        travelled=course.travelled,
        fastest=course.fastest,
        feet=course.feet,
        problems=tuple(course.problems),
        notes=tuple(notes),
        command=" ".join(words),
    )


class _Skeleton(NamedTuple):
    """Whose joints a motion has, the body's that follow them, and those no map names."""

    family: str
    joints: int
    carried: frozenset[str]
    added: tuple[str, ...]
    reference: str
    unit: str | None
    lies: bool = False


def _skeleton(
    read: SourceClip | Motion,
    told: Mapping[str, str] | None,
    body: Body,
    rest: Float[Array, "all 3"],
) -> _Skeleton:
    if isinstance(read, Motion):
        names = body.joint_names
        return _Skeleton("built-in body", len(names), frozenset(names), (), "its rest pose", "m")
    index = joint_index(read, body, told)
    return _Skeleton(
        find_joint_map(read)[0] if told is None else "own map",
        len(read.names),
        frozenset(index),
        () if told is None else tuple(sorted(index.keys() - told.keys())),
        _reference(read, index),
        _unit(read, index, body, rest),
        bool(mean_trunk(upright(read, index), index)[2] > ALWAYS),
    )


class _Course(NamedTuple):
    """What is wrong with where the person goes, what to know of it, and how far and fast."""

    problems: list[str]
    notes: list[str]
    travelled: float
    fastest: float
    feet: float


def _course(body: Body, clip: Motion, rest: Float[Array, "all 3"]) -> _Course:
    steady = clip if clip.fps <= _RATE else resample(clip, _RATE)
    steps = np.diff(np.asarray(steady.root, np.float64), axis=0)
    speeds = np.linalg.norm(steps, axis=1) * steady.fps
    fastest = float(speeds.max(initial=0.0))
    heights = foot_heights(body, steady, rest)
    feet, low = float(np.median(heights)), float(heights.min())
    problems, notes = [], []
    # As it is dressed: what turns fast enough between four frames needn't between two of them.
    turns = sudden_turns(body, steady)
    if turns is not None:
        rate = "" if steady is clip else f" (frames of {_RATE:g} a second)"
        problems.append(turns.partition(": ")[2].removesuffix(".") + f"{rate}.")
    if fastest > _FASTEST:
        frame = int(speeds.argmax() * clip.fps / steady.fps)
        problems.append(
            f"its hips go at {fastest:.0f} m/s at frame {frame}: a jump in the capture, or a wrong"
            " rate (--source-fps says the true one)."
        )
    if feet > _ABOVE:
        notes.append(
            f"its feet are {100 * feet:.0f} cm above the floor half of the time: the floor is where"
            " its lowest frame is."
        )
    if low < -_ABOVE:
        frame = int(heights.argmin() * clip.fps / steady.fps)
        notes.append(f"a foot is {-100 * low:.0f} cm below the floor at frame {frame}.")
    if clip.num_frames < 2:
        notes.append("a single frame: a pose, not a motion.")
    travelled = float(np.linalg.norm(steps[:, [0, 2]], axis=1).sum())
    return _Course(problems, notes, travelled, fastest, feet)


def _reference(source: SourceClip, index: Mapping[str, int]) -> str:
    may_have_t_pose = source.rest is None
    turned = upright(source, index)
    _, start, _ = reference_pose(turned, index, may_have_t_pose)
    if start:
        return "the T-pose in its first frame, which is left out"
    if stands(turned, index, 1):
        return "its rest pose" + (", turned upright" if turned is not source else "")
    return "the frame in which it stands straightest"


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
    return nearest if factor[nearest] < _ALIKE else None
