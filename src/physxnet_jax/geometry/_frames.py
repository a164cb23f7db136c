"""Frames one after the other, or all at once: whatever the device does best."""

from collections.abc import Callable
from typing import TypeVar

import jax
from jaxtyping import Array, Shaped

_Result = TypeVar("_Result")


def each_frame(function: Callable[..., _Result], *frames: Shaped[Array, "frames ..."]) -> _Result:
    """A function of one frame applied to each, differentiable.

    CPUs take one frame after the other: what lies between fits their caches. A gradient
    computes that anew instead of keeping it.

    Args:
        function: Of one frame of each array.
        frames: Arrays of frames.
    """
    one = jax.checkpoint(function)
    return jax.lax.platform_dependent(
        *frames,
        cpu=lambda *arrays: jax.lax.map(lambda frame: one(*frame), arrays),
        default=jax.vmap(one),
    )
