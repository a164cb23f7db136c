"""The same action as another person would do it: mirrored, slower, larger, with other arms."""

import re

import numpy as np
from jaxtyping import Int
from scipy.spatial.transform import Rotation

from ..body import Body
from ..errors import MotionError
from ._motion import Motion, check_joints, make_motion, sample

# A joint is never swung further than this from its mean [rad].
_WIDEST = 2.6


def mirror_joints(body: Body) -> Int[np.ndarray, " joints"]:
    """For each joint its counterpart on the other side; itself in the middle.

    Raises:
        MotionError: A joint of one side without its counterpart.
    """
    names = list(body.joint_names)
    swapped = [re.sub(r"^(Left|Right|[LR](?=Hip|Thumb))", _other, n) for n in names]
    missing = [s for s in swapped if s not in names]
    if missing:
        raise MotionError(
            f"the skeleton has no {', '.join(missing)}: it isn't the same on both sides."
        )
    return np.array([names.index(s) for s in swapped], dtype=np.int64)


def _other(match: re.Match[str]) -> str:
    pairs = {"Left": "Right", "Right": "Left", "L": "R", "R": "L"}
    return pairs[match.group(0)]


def mirrored(body: Body, motion: Motion) -> Motion:
    """The motion as a mirror shows it: left and right are exchanged.

    Args:
        body: The body, whose skeleton is the same on both sides.
        motion: The motion.

    Raises:
        MotionError: A skeleton with one side alone.

    Note:
        In a plane mirror x -> -x a rotation by the vector (a, b, c) becomes one by
        (a, -b, -c).
    """
    turned = np.asarray(motion.rotations)[:, mirror_joints(body)] * [1.0, 1.0, -1.0, -1.0]
    root = np.asarray(motion.root) * [-1.0, 1.0, 1.0]
    return make_motion(turned, root, motion.fps, name=motion.name)


def frames_at_speed(frames: int, speed: float) -> int:
    """How many frames are left of a clip that is played so many times as fast."""
    return int(np.floor((frames - 1) / speed + 1e-6)) + 1


def at_speed(motion: Motion, speed: float) -> Motion:
    """The motion played faster or slower, at the same frame rate.

    Args:
        motion: The motion.
        speed: How many times as fast.

    Raises:
        MotionError: A speed that isn't positive.
    """
    if not speed > 0:
        raise MotionError(f"speed is {speed}; it must be positive.")
    last = (motion.num_frames - 1) / motion.fps
    frames = frames_at_speed(motion.num_frames, speed)
    times = np.minimum(np.arange(frames) / motion.fps * speed, last)
    out = sample(motion, times, motion.fps)
    return Motion(out.rotations, out.root, motion.fps, motion.name)


def exaggerated(motion: Motion, factor: float) -> Motion:
    """The motion with every joint swung further, or less far, from its mean pose.

    The root and where it faces stay as they are.

    Args:
        motion: The motion.
        factor: How many times as far each joint turns from its mean rotation.

    Raises:
        MotionError: A factor that isn't positive.
    """
    if not factor > 0:
        raise MotionError(f"exaggeration is {factor}; it must be positive.")
    local = np.asarray(motion.rotations, dtype=np.float64)[:, 1:]
    rotations = np.array(motion.rotations, dtype=np.float64)
    for joint in range(local.shape[1]):
        turns = Rotation.from_quat(np.roll(local[:, joint], -1, axis=1))
        mean = turns.mean()
        swing = (mean.inv() * turns).as_rotvec() * factor
        # Half a turn away there is no telling which way is further.
        angle = np.linalg.norm(swing, axis=1, keepdims=True)
        swing = swing * np.minimum(1.0, _WIDEST / np.maximum(angle, _WIDEST))
        wider = (mean * Rotation.from_rotvec(swing)).as_quat()
        rotations[:, joint + 1] = np.roll(wider, 1, axis=1)
    return make_motion(rotations, motion.root, motion.fps, name=motion.name)


def with_upper_body(body: Body, motion: Motion, other: Motion) -> Motion:
    """The legs and the way of one motion with the spine, arms and head of another.

    The other motion is played to and fro until this one ends, so nothing jumps.

    Args:
        body: The body.
        motion: Root, hips and legs come from here, and the length.
        other: The rest comes from here; of the same frame rate.

    Raises:
        MotionError: Different frame rates, or a motion of another skeleton.
    """
    if motion.fps != other.fps:
        raise MotionError(f"{motion.fps} and {other.fps} frames a second: resample one of them.")
    check_joints(body, motion)
    check_joints(body, other)
    upper = _upper_joints(body)
    last = max(other.num_frames - 1, 1)
    phase = np.arange(motion.num_frames) % (2 * last)
    index = np.minimum(np.minimum(phase, 2 * last - phase), other.num_frames - 1)
    rotations = np.array(motion.rotations)
    rotations[:, upper] = np.asarray(other.rotations)[index][:, upper]
    return make_motion(rotations, motion.root, motion.fps, name=motion.name)


def _upper_joints(body: Body) -> Int[np.ndarray, " n"]:
    """All joints that hang from a joint whose name begins with Spine or LowerBack."""
    above = []
    for joint, (name, parent) in enumerate(zip(body.joint_names, body.parents, strict=True)):
        if name.startswith(("Spine", "LowerBack")) or parent in above:
            above.append(joint)
    if not above:
        raise MotionError("the skeleton has no spine: there is no upper body to exchange.")
    return np.array(above, dtype=np.int64)
