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
    points: Float[Array, "frames texels 3"], fps: float
) -> Float[Array, "frames texels 3"]:
    """I_v[k] = I_B[k] - I_B[k-1], in m/s (PhysXNet, equation 6).

    The first frame is repeated before itself, so its velocity is zero.

    Args:
        points: Surface points of successive frames [m].
        fps: Frames a second.

    Note (differs from the paper):
        Scaled by the frame rate, so that the network sees the same physics at any.
    """
    before = jnp.concatenate([points[:1], points[:-1]])
    return (points - before) * fps


def acceleration_maps(
    points: Float[Array, "frames texels 3"], fps: float
) -> Float[Array, "frames texels 3"]:
    """I_a[k] = I_v[k] - I_v[k-1], in m/s^2 (PhysXNet, equation 7).

    Args:
        points: Texels' positions [m], not their velocities: these are computed here.
        fps: Frames a second.
    """
    velocity = velocity_maps(points, fps)
    before = jnp.concatenate([jnp.zeros_like(velocity[:1]), velocity[:-1]])
    return (velocity - before) * fps


def garment_map(
    to_cloth: Transference,
    cloth: Float[Array, "*batch vertices 3"],
    points: Float[Array, "*batch texels 3"],
) -> Float[Array, "*batch texels 3"]:
    """I_C = T_BC M_C - I_B: offsets from skin to cloth [m] (PhysXNet, equation 8).

    Texels whose ray met no cloth are zero; see ``to_cloth.valid``.
    """
    offset = to_cloth @ cloth - points
    valid = to_cloth.valid.reshape((1,) * (offset.ndim - 2) + (-1, 1))
    return jnp.where(valid, offset, jnp.zeros_like(offset))
