"""Joint transforms of a clip, in blocks of one size so that nothing is recompiled."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..body import Body
from ..geometry import quaternion_conjugate, quaternion_multiply, safe_normalize
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

    Every joint turns, and the root goes, as fast as between the clip's first two poses: no
    acceleration is made up, where a person who stood still until then would be thrown into
    motion within a frame, the harder the more frames a second there are.

    Args:
        rotations: Joint rotations of the clip, wxyz.
        root: Positions of the root joint [m].
        count: Poses wanted; who has a single pose stood still in it.

    Returns:
        Rotations and root positions, oldest first.
    """
    rotations, root = jnp.asarray(rotations), jnp.asarray(root)
    if count == 0:
        return rotations[:0], root[:0]
    # In JAX's numbers: an exported clip's length is none of NumPy's.
    second = jnp.minimum(1, rotations.shape[0] - 1)
    q, p = rotations[second], root[second]
    # A pose that isn't finite spoils no frame before it.
    known = jnp.isfinite(q).all() & jnp.isfinite(p).all()
    q, p = jnp.where(known, q, rotations[0]), jnp.where(known, p, root[0])
    step = safe_normalize(quaternion_multiply(rotations[0], quaternion_conjugate(q)))
    turns, places = [], []
    last, at = rotations[0], root[0]
    for _ in range(count):
        last, at = quaternion_multiply(step, last), at + (root[0] - p)
        turns.append(last)
        places.append(at)
    return jnp.stack(turns[::-1]), jnp.stack(places[::-1])


def before_transforms(
    body: Body,
    rest: Float[Array, "all 3"],
    motion: Motion,
    count: int,
    past: Motion | None = None,
) -> tuple[Float[np.ndarray, "before joints 3 3"], Float[np.ndarray, "before joints 3"]]:
    """`clip_transforms` of what was before a clip.

    Args:
        body: The body.
        rest: Its rest vertices [m].
        motion: The clip.
        count: Frames wanted.
        past: Those of the same motion that come before it; what lies before them is
            `poses_before`.
    """
    joints = len(body.parents)
    if count == 0:
        return np.zeros((0, joints, 3, 3), np.float32), np.zeros((0, joints, 3), np.float32)
    q, p = jnp.asarray(motion.rotations), jnp.asarray(motion.root)
    known = 0 if past is None else min(count, past.num_frames)
    if past is not None and known:
        q = jnp.concatenate([jnp.asarray(past.rotations)[-known:], q])
        p = jnp.concatenate([jnp.asarray(past.root)[-known:], p])
    early = poses_before(q, p, count - known)
    q, p = (jnp.concatenate([a, b[:known]]) for a, b in zip(early, (q, p), strict=True))
    return clip_transforms(body, rest, Motion(q, p, motion.fps, motion.name))


def padded_block(values: np.ndarray, start: int, before: int) -> np.ndarray:
    """``BLOCK`` frames from ``start`` and some before it; the ends are repeated."""
    index = np.arange(start - before, start + BLOCK)
    return values[np.clip(index, 0, len(values) - 1)]
