"""Joint transforms of a clip, in blocks of fixed size to avoid recompilation."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..body import Body
from ..geometry import quaternion_conjugate, quaternion_multiply, safe_normalize
from ._motion import Motion, check_joints

BLOCK = 16
"""Frames per block."""
# Time [s] in which a joint's turning before the clip fades to 1/e. With 0.1 to 0.2 s, cloth of
# clips cut short is nearest to that of whole clips; a bell adds no acceleration at the start.
_SWING = 0.15


def clip_transforms(
    body: Body, rest: Float[Array, "all 3"], motion: Motion
) -> tuple[Float[np.ndarray, "frames joints 3 3"], Float[np.ndarray, "frames joints 3"]]:
    """World rotations and translations [m] of the joints in every frame."""
    check_joints(body, motion)
    return pose_transforms(body, rest, np.asarray(motion.rotations), np.asarray(motion.root))


def pose_transforms(
    body: Body,
    rest: Float[Array, "all 3"],
    rotations: Float[np.ndarray, "frames joints 4"],
    root: Float[np.ndarray, "frames 3"],
) -> tuple[Float[np.ndarray, "frames joints 3 3"], Float[np.ndarray, "frames joints 3"]]:
    """`clip_transforms` of poses [m]."""
    frames = len(rotations)
    pick = np.minimum(np.arange(-(-frames // BLOCK) * BLOCK), frames - 1)
    q, p = rotations[pick], root[pick]
    parts = [
        _transforms(body, rest, q[i : i + BLOCK], p[i : i + BLOCK])
        for i in range(0, len(pick), BLOCK)
    ]
    world, shift = (np.concatenate([np.asarray(x[k]) for x in parts]) for k in range(2))
    return world[:frames], shift[:frames]


@jax.jit
def _transforms(body: Body, rest: Array, q: Array, p: Array) -> tuple[Array, Array]:
    return jax.vmap(lambda a, b: body.transforms(rest, a, b))(jnp.asarray(q), jnp.asarray(p))


@functools.partial(jax.jit, static_argnames=("count", "fps"))
def extrapolate_history(
    rotations: Float[Array, "frames joints 4"],
    root: Float[Array, "frames 3"],
    count: int,
    fps: float,
) -> tuple[Float[Array, "before joints 4"], Float[Array, "before 3"]]:
    """Extrapolates poses before frame 0; pure.

    The root keeps the velocity between the clip's first two poses. Joints have it in the
    frame before the clip; further back it fades within some 0.15 s, since limbs swing: at a
    constant rate a leg would be turned through half a stride too far. A person
    at rest before frame 0 would instead be accelerated within one frame, more strongly at
    higher frame rates.

    Args:
        rotations: Joint rotations of the clip, wxyz.
        root: Positions of the root joint [m].
        count: Number of poses; a one-frame clip is treated as static.
        fps: Frames per second.

    Returns:
        Rotations and root positions, oldest first.
    """
    rotations, root = jnp.asarray(rotations), jnp.asarray(root)
    if count == 0:
        return rotations[:0], root[:0]
    # With jnp, not NumPy: the length of an exported clip may be symbolic.
    second = jnp.minimum(1, rotations.shape[0] - 1)
    q, p = rotations[second], root[second]
    # A second pose that isn't finite must not spread to the frames before it.
    known = jnp.isfinite(q).all() & jnp.isfinite(p).all()
    q, p = jnp.where(known, q, rotations[0]), jnp.where(known, p, root[0])
    step = safe_normalize(quaternion_multiply(rotations[0], quaternion_conjugate(q)))
    # What is still stays still to the bit; gradients are those of the turn.
    still = jnp.zeros_like(step).at[..., 0].set(1.0)
    same = jnp.all(rotations[0] == q, axis=-1, keepdims=True)
    step = step + jax.lax.stop_gradient(jnp.where(same, still - step, 0.0))
    # The shorter way round, of which a part is taken further back.
    step = jnp.where(step[..., :1] < 0.0, -step, step)
    ago = jnp.arange(count - 1, -1, -1, dtype=step.dtype)
    part = jnp.exp(-((ago / (fps * _SWING)) ** 2))

    def further(now: tuple[Array, Array], part: Array) -> tuple[tuple[Array, Array], tuple]:
        turn = safe_normalize(still + part * (step - still))
        last, at = quaternion_multiply(turn, now[0]), now[1] + (root[0] - p)
        return (last, at), (last, at)

    turns, places = jax.lax.scan(further, (rotations[0], root[0]), part, reverse=True)[1]
    return turns, places


def history_transforms(
    body: Body,
    rest: Float[Array, "all 3"],
    motion: Motion,
    count: int,
    past: Motion | None = None,
) -> tuple[Float[np.ndarray, "before joints 3 3"], Float[np.ndarray, "before joints 3"]]:
    """`clip_transforms` of the frames before a clip.

    Args:
        body: The body.
        rest: Its rest vertices [m].
        motion: The clip.
        count: Number of frames.
        past: Frames of the same motion before the clip; earlier ones are extrapolated
            (`extrapolate_history`).
    """
    joints = len(body.parents)
    if count == 0:
        return np.zeros((0, joints, 3, 3), np.float32), np.zeros((0, joints, 3), np.float32)
    q, p = jnp.asarray(motion.rotations), jnp.asarray(motion.root)
    known = 0 if past is None else min(count, past.num_frames)
    if past is not None and known:
        q = jnp.concatenate([jnp.asarray(past.rotations)[-known:], q])
        p = jnp.concatenate([jnp.asarray(past.root)[-known:], p])
    early = extrapolate_history(q, p, count - known, motion.fps)
    q, p = (jnp.concatenate([a, b[:known]]) for a, b in zip(early, (q, p), strict=True))
    return clip_transforms(body, rest, Motion(q, p, motion.fps, motion.name))


def padded_block(values: np.ndarray, start: int, before: int, frames: int = BLOCK) -> np.ndarray:
    """So many frames from ``start`` and ``before`` frames ahead of it; ends are repeated."""
    index = np.arange(start - before, start + frames)
    return values[np.clip(index, 0, len(values) - 1)]
