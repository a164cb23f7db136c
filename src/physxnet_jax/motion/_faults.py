"""Detection of motion faults that affect the clothes."""

import pathlib

import numpy as np

from ..body import Body
from ._motion import Motion

# Largest plausible turn of a limb from frame to frame [degrees], at 30 fps or more.
_MAX_TURN = 60.0
# CMU subjects whose converted files declare 120 frames per second and have 60.
_SLOW_SUBJECTS = ("60", "61")
_JOINTS = ("Hips", "Spine", "UpLeg", "Leg", "Arm", "ForeArm")


def sudden_turns(body: Body, motion: Motion) -> str | None:
    """Reports limbs that turn over within a frame, as can happen in captured motion.

    Args:
        body: The body.
        motion: The motion.

    Returns:
        A sentence with the joint, the frame and the number of affected frames; None if no
        joint turns faster than a person can.
    """
    q = np.asarray(motion.rotations, np.float64)
    if len(q) < 2:
        return None
    names = body.joint_names
    rows = [
        k for k, n in enumerate(names) if n.removeprefix("Left").removeprefix("Right") in _JOINTS
    ]
    dots = np.abs(np.sum(q[1:, rows] * q[:-1, rows], axis=2))
    lengths = np.linalg.norm(q[:, rows], axis=2)
    cosine = np.clip(dots / np.maximum(lengths[1:] * lengths[:-1], 1e-12), 0.0, 1.0)
    degrees = np.degrees(2.0 * np.arccos(cosine))
    sudden = degrees > _MAX_TURN * max(1.0, 30.0 / motion.fps)
    if not sudden.any():
        return None
    frame, which = np.unravel_index(int(degrees.argmax()), degrees.shape)
    more = int(sudden.any(axis=1).sum()) - 1
    others = f", and {more} other frames are affected" if more > 1 else ""
    others = ", and another frame is affected" if more == 1 else others
    return (
        f"{motion.name or 'the motion'}: {names[rows[which]]} turns by {degrees[frame, which]:.0f}"
        f" degrees from frame {frame} to {frame + 1}{others}: no limb turns that"
        " fast, and the clothes will be flung about there."
    )


def slow_subject(path: str | pathlib.Path) -> str | None:
    """CMU's subject that a file is named after, if such files declare twice the true rate."""
    subject = pathlib.Path(str(path)).stem.partition("_")[0].lstrip("0")
    return subject if subject in _SLOW_SUBJECTS else None
