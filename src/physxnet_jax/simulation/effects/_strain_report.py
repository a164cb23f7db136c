"""What elastic effects report of their strains."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from .._quantile import upper_quantile

# An edge that has lost more of its length counts as collapsed.
_COLLAPSED = -0.8


def strain_report(strain: Float[Array, "edges batch"]) -> dict[str, Float[Array, " batch"]]:
    """Diagnostics of a frame from the elongation of every edge or thread [1]."""
    return {
        "strain_max": strain.max(axis=0),
        "strain_p99": upper_quantile(strain, 0.99),
        "collapsed": jnp.mean(strain < _COLLAPSED, axis=0, dtype=strain.dtype),
    }
