"""Joint transforms of a clip, in blocks of one size so that nothing is recompiled."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..body import Body
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


def padded_block(values: np.ndarray, start: int, before: int) -> np.ndarray:
    """``BLOCK`` frames from ``start`` and some before it; the ends are repeated."""
    index = np.arange(start - before, start + BLOCK)
    return values[np.clip(index, 0, len(values) - 1)]
