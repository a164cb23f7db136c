"""Variants of a motion: mirrored, faster, exaggerated, subdued, with another upper body."""

import re

import numpy as np
from jaxtyping import Int
from scipy.spatial.transform import Rotation

from ..body import Body
from ..errors import MotionError
from ._motion import Motion, check_joints, make_motion, sample
from ._retarget import foot_heights

# Limit of an exaggerated joint's angle from its mean [rad].
_MAX_SWING = 2.6


def mirror_joints(body: Body) -> Int[np.ndarray, " joints"]:
    """Index of each joint's counterpart on the other side, its own for a middle joint.

    Raises:
        MotionError: A joint has no counterpart on the other side.
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
    """Mirrors a motion: left and right are exchanged.

    Args:
        body: The body; its skeleton must be the same on both sides.
        motion: The motion.

    Raises:
        MotionError: The skeleton isn't the same on both sides.

    Note:
        In a plane mirror x -> -x a rotation by the vector (a, b, c) becomes one by
        (a, -b, -c).
    """
    turned = np.asarray(motion.rotations)[:, mirror_joints(body)] * [1.0, 1.0, -1.0, -1.0]
    root = np.asarray(motion.root) * [-1.0, 1.0, 1.0]
    return make_motion(turned, root, motion.fps, name=motion.name)


def frames_at_speed(frames: int, speed: float) -> int:
    """Number of frames of a clip when it is played at ``speed`` times its speed."""
    return int(np.floor((frames - 1) / speed + 1e-6)) + 1


def at_speed(motion: Motion, speed: float) -> Motion:
    """The motion played faster or slower, at the same frame rate.

    Args:
        motion: The motion.
        speed: Speed factor; above 1 is faster.

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
    """Scales every joint's rotation relative to its mean.

    The root keeps its position and orientation.

    Args:
        motion: The motion.
        factor: Factor on the angle between each joint's rotation and its mean.

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
        # At half a turn from the mean, the direction of the swing is ambiguous.
        angle = np.linalg.norm(swing, axis=1, keepdims=True)
        swing = swing * np.minimum(1.0, _MAX_SWING / np.maximum(angle, _MAX_SWING))
        wider = (mean * Rotation.from_rotvec(swing)).as_quat()
        rotations[:, joint + 1] = np.roll(wider, 1, axis=1)
    return make_motion(rotations, motion.root, motion.fps, name=motion.name)


def subdued(body: Body, motion: Motion, factor: float) -> Motion:
    """Scales a motion down to a person who stands almost still: nobody captures those.

    Every joint's angle from the rest pose, the lean of the root, its turns and its way along the
    floor, each from their mean, are scaled. In every frame the lower foot is on the floor.

    Args:
        body: The body.
        motion: The motion.
        factor: Factor on all of them, more than 0 and at most 1.

    Raises:
        MotionError: Another factor.
    """
    if not 0 < factor <= 1:
        raise MotionError(f"the factor is {factor}; it must be more than 0 and at most 1.")
    quaternions = np.roll(np.asarray(motion.rotations, dtype=np.float64), -1, axis=2)
    out = np.array(quaternions)
    for joint in range(1, out.shape[1]):
        swing = Rotation.from_quat(quaternions[:, joint]).as_rotvec()
        out[:, joint] = Rotation.from_rotvec(factor * swing).as_quat()
    root = Rotation.from_quat(quaternions[:, 0])
    ahead = root.apply([0.0, 0.0, 1.0])
    heading = np.unwrap(np.arctan2(ahead[:, 0], ahead[:, 2]))
    lean = (Rotation.from_euler("y", heading[:, None]).inv() * root).as_rotvec()
    heading = heading.mean() + factor * (heading - heading.mean())
    leaned = Rotation.from_euler("y", heading[:, None]) * Rotation.from_rotvec(factor * lean)
    out[:, 0] = leaned.as_quat()
    place = np.asarray(motion.root, dtype=np.float64)
    place = place.mean(axis=0) + factor * (place - place.mean(axis=0))
    still = make_motion(np.roll(out, 1, axis=2), place, motion.fps, name=motion.name)
    place[:, 1] -= foot_heights(body, still, body.rest_vertices(body.default_shape()))
    return make_motion(still.rotations, place, motion.fps, name=motion.name)


def with_upper_body(body: Body, motion: Motion, other: Motion) -> Motion:
    """Combines the root and legs of one motion with the spine, arms and head of another.

    The other motion is played forwards and backwards until this one ends, to avoid jumps.

    Args:
        body: The body.
        motion: Motion of the root, hips and legs; its length is kept.
        other: Motion of the upper body, at the same frame rate.

    Raises:
        MotionError: Different frame rates, or a motion of another skeleton.
    """
    if motion.fps != other.fps:
        raise MotionError(f"{motion.fps} and {other.fps} frames per second: resample one of them.")
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
    """Joints whose names begin with Spine or LowerBack, and all their descendants."""
    above = []
    for joint, (name, parent) in enumerate(zip(body.joint_names, body.parents, strict=True)):
        if name.startswith(("Spine", "LowerBack")) or parent in above:
            above.append(joint)
    if not above:
        raise MotionError("the skeleton has no spine: there is no upper body to exchange.")
    return np.array(above, dtype=np.int64)
