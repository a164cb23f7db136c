"""Motion as the network sees it: texel velocities and accelerations of three frames."""

from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..body import blend_rotations
from ..geometry import polar_rotation
from ..uv import acceleration_maps, velocity_maps

Family = Literal["paper", "local"]
WINDOW = 5
"""Poses needed for one answer: accelerations of three frames reach four frames back."""

_EXACT = jax.lax.Precision.HIGHEST


def num_channels(family: Family) -> int:
    """Input channels: six of each of three frames, and gravity for ``local``."""
    return 18 if family == "paper" else 21


def skin_points(
    rest: Float[Array, "points 3"],
    weights: Float[Array, "points joints"],
    rotations: Float[Array, "joints 3 3"],
    translations: Float[Array, "joints 3"],
) -> tuple[Float[Array, "points 3"], Float[Array, "points 3 3"]]:
    """Skinned points [m] and the linear part of their skinning."""
    blend = blend_rotations(weights, rotations)
    shift = jnp.matmul(weights, translations, precision=_EXACT)
    return jnp.einsum("pab,pb->pa", blend, rest, precision=_EXACT) + shift, blend


def clip_features(
    rest: Float[Array, "texels 3"],
    weights: Float[Array, "texels joints"],
    rotations: Float[Array, "padded joints 3 3"],
    translations: Float[Array, "padded joints 3"],
    fps: float,
    family: Family,
) -> Float[Array, "frames texels channels"]:
    """Features of successive frames, each point skinned once.

    Channels: velocities [m/s] of frames k-2, k-1, k, accelerations [m/s^2] of the
    same, and for ``local`` the direction of gravity. ``paper`` gives them in the
    world's frame, ``local`` in each texel's own frame at k: the rotation nearest to its
    skinning. Turning the person about the vertical axis leaves ``local`` features
    as they are.

    Args:
        rest: Texel points at rest [m].
        weights: Their skinning weights.
        rotations: World rotations of joints of all frames, with four frames before the
            first one wanted; repeat the first frame there at a clip's start.
        translations: World translations of joints [m], likewise.
        fps: Frames a second.
        family: Which features.

    Returns:
        Features of every covered texel; four frames fewer than poses.

    References:
        PhysXNet, section 3.1: X = (I_v, I_a) of frames k-2 to k.
    """
    points, blends = jax.vmap(skin_points, in_axes=(None, None, 0, 0))(
        rest, weights, rotations, translations
    )
    velocity = velocity_maps(points, fps)
    acceleration = acceleration_maps(points, fps)
    frames = rotations.shape[0] - (WINDOW - 1)
    both = jnp.stack(
        [x[2 + k : 2 + k + frames] for x in (velocity, acceleration) for k in range(3)],
        axis=2,
    )
    if family == "paper":
        return both.reshape(frames, rest.shape[0], 18)
    frame = polar_rotation(blends[WINDOW - 1 :])
    turned = jnp.einsum("fpba,fpkb->fpka", frame, both, precision=_EXACT)
    gravity = -frame[:, :, 1, :]
    return jnp.concatenate([turned.reshape(frames, rest.shape[0], 18), gravity], axis=2)
