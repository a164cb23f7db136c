"""The floor: a horizontal plane with Coulomb friction."""

import dataclasses
import math
import numbers
from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...errors import check_numbers
from ...typing import pytree
from .._assembly import Assembly, float32
from .._effect import Clock, Effect, Prepared, Step


@dataclasses.dataclass(frozen=True)
class Floor(Effect):
    """Keeps cloth at least half its thickness above a plane, with the fabric's friction.

    Cloth below the plane, as a hem under a foot that a motion puts through the floor, is lifted
    at most ``push`` in a substep.

    Attributes:
        height: Height of the floor [m]; the feet of loaded motions stand at 0.
        push: Largest correction in one substep [m].

    References:
        Friction as a clamped tangential move: Mueller et al., Position based dynamics
        (2007), section 3.4.
    """

    height: float = 0.0
    push: float = 1.0

    def __post_init__(self) -> None:
        check_numbers(self, "push")
        if not isinstance(self.height, numbers.Real) or not math.isfinite(self.height):
            raise ValueError(f"height is {self.height!r}, expected a number in metres")

    def prepare(self, assembly: Assembly, inverse_mass: Array) -> Prepared:
        """Collects the lowest height and the friction of every vertex."""
        # Rests on the floor with its middle plane.
        lowest = self.height + 0.5 * assembly.thickness
        return _Floor(
            float32(lowest[:, None]),
            float32(assembly.friction[:, None, None]),
            float32((np.asarray(inverse_mass) > 0)[:, None]),
            self.push,
        )


@pytree
@dataclasses.dataclass(frozen=True)
class _Floor(Prepared):
    unilateral = True
    lowest: Float[Array, "vertices 1"]
    friction: Float[Array, "vertices 1 1"]
    free: Float[Array, "vertices 1"]
    push: float = dataclasses.field(metadata={"static": True})

    materials = ("friction",)

    def rescaled(self, factors: Mapping[str, Any]) -> Prepared:
        if "friction" not in factors:
            return self
        return dataclasses.replace(self, friction=self.friction * factors["friction"])

    def reshaped(self, rest: Any) -> Prepared:
        # Neither depends on shapes.
        return self

    def begin(self, base: Array, start: Any, end: Any, clock: Clock, state: Any) -> Array:
        return self.lowest - base[:, 1]

    def project(
        self, displacement: Array, start: Array, context: Array, progress: Array, step: Step
    ) -> Array:
        lift = jnp.clip(context - displacement[:, 1], 0.0, self.push) * self.free
        across = jnp.asarray([1.0, 0.0, 1.0], displacement.dtype)[None, :, None]
        slide = (displacement - start) * across
        length = jnp.sqrt(jnp.sum(slide * slide, axis=1, keepdims=True) + 1e-18)
        hold = jnp.minimum(1.0, self.friction * lift[:, None] / length)
        return (displacement - hold * slide).at[:, 1].add(lift)

    def diagnose(self, displacement: Array, context: Array) -> dict[str, Array]:
        below = (context - displacement[:, 1]) * self.free
        return {"below_floor_max": jnp.maximum(jnp.max(below, axis=0), 0.0)}
