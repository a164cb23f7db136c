"""Quantiles for diagnostics, several times as fast as sorting on a CPU."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


def upper_quantile(x: Float[Array, "values batch"], share: float) -> Float[Array, " batch"]:
    """The smallest value that at least this share of the values doesn't exceed.

    Found bit by bit, by counting; not differentiable. NaN counts as larger than all numbers.

    Args:
        x: Values of each batch member.
        share: The share, from 0 to 1.
    """
    x = jax.lax.stop_gradient(x)
    bits = 8 * x.dtype.itemsize
    kind = jnp.int32 if bits == 32 else jnp.int64
    lowest = jnp.array(jnp.iinfo(kind).min, kind)
    # Integers in the order of the floats: those of negative floats run backwards.
    code = jax.lax.bitcast_convert_type(jnp.where(jnp.isnan(x), jnp.inf, x), kind)
    code = jnp.where(code < 0, lowest - code - 1, code)
    needed = max(1, round(share * (x.shape[0] - 1)) + 1)

    def halve(k: Array, low: Array) -> Array:
        middle = low + (jnp.array(1, kind) << jnp.asarray(bits - 1 - k, kind))
        below = jnp.sum(code < middle[None], axis=0, dtype=jnp.int32)
        return jnp.where(below < needed, middle, low)

    low = jnp.broadcast_to(lowest, x.shape[1:])
    low = jax.lax.fori_loop(0, bits, halve, low)
    low = jnp.where(low < 0, lowest - low - 1, low)
    return jax.lax.bitcast_convert_type(low, x.dtype)
