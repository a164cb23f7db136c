"""Joint transforms of a clip, in blocks of one size so that nothing is recompiled."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..body import Body
from ..geometry import quaternion_conjugate, quaternion_multiply
from ._motion import Motion, check_joints

BLOCK = 16
"""Frames computed together."""


def clip_transforms(
    body: Body, rest: Float[Array, "all 3"], motion: Motion
) -> tuple[Float[np.ndarray, "frames joints 3 3"], Float[np.ndarray, "frames joints 3"]]:
    """World rotations and translations [m] of the joints in every frame."""
    check_joints(body, motion)
    frames = motion.num_frames
    pick = np.minimum(np.arange(-(-frames // BLOCK) * BLOCK), frames - 1)
    q, p = np.asarray(motion.rotations)[pick], np.asarray(motion.root)[pick]
    parts = [
        _transforms(body, rest, q[i : i + BLOCK], p[i : i + BLOCK])
        for i in range(0, len(pick), BLOCK)
    ]
    world, shift = (np.concatenate([np.asarray(x[k]) for x in parts]) for k in range(2))
    return world[:frames], shift[:frames]


@jax.jit
def _transforms(body: Body, rest: Array, q: Array, p: Array) -> tuple[Array, Array]:
    return jax.vmap(lambda a, b: body.transforms(rest, a, b))(jnp.asarray(q), jnp.asarray(p))


def poses_before(
    rotations: Float[Array, "frames joints 4"],
    root: Float[Array, "frames 3"],
    count: int,
) -> tuple[Float[Array, "before joints 4"], Float[Array, "before 3"]]:
    """What a person did before a clip began, if it went on as it begins; pure.

    The clip's start, mirrored in time about its first pose: velocities go on and no
    acceleration is made up, where a person who stood still until then would be thrown into
    motion within a frame, the harder the more frames a second there are.

    Args:
        rotations: Joint rotations of the clip, wxyz.
        root: Positions of the root joint [m].
        count: Poses wanted; those of a shorter clip end with its last.

    Returns:
        Rotations and root positions, oldest first.
    """
    # In JAX's numbers: an exported clip's length is none of NumPy's.
    after = jnp.minimum(jnp.arange(count, 0, -1), rotations.shape[0] - 1)
    q, p = rotations[after], root[after]
    # A pose that isn't finite spoils no frame before it.
    known = jnp.isfinite(q).all(axis=(1, 2)) & jnp.isfinite(p).all(axis=1)
    q = jnp.where(known[:, None, None], q, rotations[:1])
    p = jnp.where(known[:, None], p, root[:1])
    first = jnp.broadcast_to(rotations[:1], q.shape)
    back = quaternion_multiply(quaternion_multiply(first, quaternion_conjugate(q)), first)
    return back, 2.0 * root[:1] - p


def before_transforms(
    body: Body, rest: Float[Array, "all 3"], motion: Motion, count: int
) -> tuple[Float[np.ndarray, "before joints 3 3"], Float[np.ndarray, "before joints 3"]]:
    """`clip_transforms` of `poses_before`."""
    joints = len(body.parents)
    if count == 0:
        return np.zeros((0, joints, 3, 3), np.float32), np.zeros((0, joints, 3), np.float32)
    q, p = poses_before(jnp.asarray(motion.rotations), jnp.asarray(motion.root), count)
    return clip_transforms(body, rest, Motion(q, p, motion.fps, motion.name))


def padded_block(values: np.ndarray, start: int, before: int) -> np.ndarray:
    """``BLOCK`` frames from ``start`` and some before it; the ends are repeated."""
    index = np.arange(start - before, start + BLOCK)
    return values[np.clip(index, 0, len(values) - 1)]
