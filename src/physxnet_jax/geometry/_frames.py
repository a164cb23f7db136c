"""Mapping over frames, sequentially or vectorised depending on the device."""

from collections.abc import Callable
from typing import TypeVar

import jax
from jaxtyping import Array, Shaped

_Result = TypeVar("_Result")


def map_frames(function: Callable[..., _Result], *frames: Shaped[Array, "frames ..."]) -> _Result:
    """Applies a function of one frame to every frame; differentiable.

    CPUs process one frame after another, so that intermediates fit their caches. Gradients
    recompute intermediates instead of storing them.

    Args:
        function: Function of one frame of each array.
        frames: Arrays with a leading frame axis.
    """
    one = jax.checkpoint(function)
    return jax.lax.platform_dependent(
        *frames,
        cpu=lambda *arrays: jax.lax.map(lambda frame: one(*frame), arrays),
        default=jax.vmap(one),
    )
