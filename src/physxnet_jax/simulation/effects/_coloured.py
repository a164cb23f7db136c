"""Gathering and scattering of groups of elements that share no vertex."""

import jax.numpy as jnp
from jaxtyping import Array, Int


def scatter_rows(target: Array, index: list[Int[Array, " members"]], rows: list[Array]) -> Array:
    """Rows put back where they were gathered from; no index occurs twice."""
    return target.at[jnp.concatenate(index)].set(jnp.concatenate(rows), unique_indices=True)
