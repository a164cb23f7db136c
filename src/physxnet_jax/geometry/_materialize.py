"""Values that are computed once: XLA computes cheap ones anew wherever they are read."""

from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array

_materialize = Primitive("materialize")


def materialize(tree: Any) -> Any:
    """Returns arrays unchanged, which a CPU computes once and keeps in memory.

    XLA's fusion for CPUs merges arithmetic into the gathers, reductions and concatenations that
    read it, where it is repeated for each element read and no longer vectorised. Results that are
    computed twice can also differ in their last bit. ``jax.lax.optimization_barrier`` prevents
    neither: XLA removes it before fusion. Other devices need no such help: there nothing is done.

    Args:
        tree: Floating-point arrays.

    Example:
        >>> materialize(jnp.ones(3)).shape
        (3,)
    """
    return jax.tree.map(lambda x: _materialize.bind(x) if x.size else x, tree)


def _branched(x: Array) -> Array:
    """The result of a branch is kept in memory; this one is always taken."""
    first = jnp.reshape(x[(slice(0, 1),) * x.ndim], ())
    # Zero or NaN, whatever the value: nothing that a compiler could know.
    taken = first * jnp.zeros_like(first) != jnp.ones_like(first)
    return jax.lax.cond(taken, lambda v: v, jnp.zeros_like, x)


_materialize.def_impl(lambda x: x)
_materialize.def_abstract_eval(lambda x: x)
mlir.register_lowering(_materialize, lambda context, x: [x])
mlir.register_lowering(
    _materialize, mlir.lower_fun(_branched, multiple_results=False), platform="cpu"
)
batching.primitive_batchers[_materialize] = lambda x, axis: (_materialize.bind(*x), *axis)
ad.deflinear2(_materialize, lambda cotangent, x: [_materialize.bind(cotangent)])
