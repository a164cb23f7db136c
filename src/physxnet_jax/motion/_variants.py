"""The same action as another person would do it: mirrored, slower, faster."""

import re

import numpy as np
from jaxtyping import Int

from ..body import Body
from ..errors import MotionError
from ._motion import Motion, make_motion, sample


def mirror_joints(body: Body) -> Int[np.ndarray, " joints"]:
    """For each joint its counterpart on the other side; itself in the middle.

    Raises:
        MotionError: A joint of one side without its counterpart.
    """
    names = list(body.joint_names)
    swapped = [re.sub(r"^(Left|Right|L(?=Hip)|R(?=Hip))", _other, n) for n in names]
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
    frames = int(np.floor(last / speed * motion.fps + 1e-6)) + 1
    times = np.minimum(np.arange(frames) / motion.fps * speed, last)
    out = sample(motion, times, motion.fps)
    return Motion(out.rotations, out.root, motion.fps, motion.name)
