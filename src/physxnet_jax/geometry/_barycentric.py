"""Barycentric interpolation."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int


@jax.jit
def interpolate(
    values: Float[Array, "*batch vertices channels"],
    faces: Int[Array, "points 3"],
    weights: Float[Array, "points 3"],
) -> Float[Array, "*batch points channels"]:
    """Values at points given by three vertices and their weights.

    Args:
        values: Values at vertices, any unit.
        faces: The three vertices of every point.
        weights: Their weights.

    Returns:
        Interpolated values.
    """
    out = jnp.zeros((), values.dtype)
    for k in range(3):
        term = values[..., faces[:, k], :] * _lift(weights[:, k, None], values.ndim)
        out = term if k == 0 else out + term
    return out


def _lift(x: Array, ndim: int) -> Array:
    return x.reshape((1,) * (ndim - x.ndim) + x.shape)
