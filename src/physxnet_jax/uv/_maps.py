"""Body maps, velocity and acceleration maps, and garment maps."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from ._transference import Transference


def body_map(
    to_body: Transference, vertices: Float[Array, "*batch vertices 3"]
) -> Float[Array, "*batch texels 3"]:
    """I_B = T_UB M_B: surface points of texels [m] (PhysXNet, equation 5)."""
    return to_body @ vertices


def velocity_maps(
    points: Float[Array, "frames texels 3"], fps: float, span: int = 1
) -> Float[Array, "frames texels 3"]:
    """I_v[k] = I_B[k] - I_B[k-1], in m/s (PhysXNet, equation 6).

    The first frame is also used as its own predecessor, so its velocity is zero.

    Args:
        points: Texel positions of successive frames [m].
        fps: Frames per second.
        span: Frames over which differences are taken.

    Note (differs from the paper):
        Scaled by the frame rate, so that the network's inputs don't depend on it.
    """
    before = jnp.concatenate([jnp.repeat(points[:1], span, axis=0), points[:-span]])
    return (points - before) * (fps / span)


def acceleration_maps(
    points: Float[Array, "frames texels 3"], fps: float, span: int = 1
) -> Float[Array, "frames texels 3"]:
    """I_a[k] = I_v[k] - I_v[k-1], in m/s^2 (PhysXNet, equation 7).

    Args:
        points: Texel positions [m], not velocities: these are computed here.
        fps: Frames per second.
        span: Frames over which differences are taken.
    """
    velocity = velocity_maps(points, fps, span)
    before = jnp.concatenate([jnp.zeros_like(velocity[:span]), velocity[:-span]])
    return (velocity - before) * (fps / span)


def cloth_offsets(
    to_cloth: Transference,
    cloth: Float[Array, "*batch vertices 3"],
    points: Float[Array, "*batch texels 3"],
) -> Float[Array, "*batch texels 3"]:
    """I_C = T_BC M_C - I_B: offsets from skin to cloth [m] (PhysXNet, equation 8).

    Texels whose ray hit no cloth are zero; see ``to_cloth.valid``.
    """
    offset = to_cloth @ cloth - points
    valid = to_cloth.valid.reshape((1,) * (offset.ndim - 2) + (-1, 1))
    return jnp.where(valid, offset, jnp.zeros_like(offset))
