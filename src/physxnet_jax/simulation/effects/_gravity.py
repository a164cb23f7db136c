"""Gravity: a constant acceleration."""

import dataclasses
import math

from jaxtyping import Array

from ...typing import pytree
from .._assembly import Assembly
from .._effect import Effect, Prepared, Rest


@dataclasses.dataclass(frozen=True)
class Gravity(Effect):
    """``a = (0, -g, 0)``.

    Attributes:
        g: Acceleration downwards [m/s^2].
    """

    g: float = 9.81

    def __post_init__(self) -> None:
        if not math.isfinite(self.g):
            raise ValueError(f"g is {self.g}, expected a finite number")

    def idle(self, assembly: Assembly) -> bool:
        """Weightless."""
        return self.g == 0.0

    def prepare(self, assembly: Assembly, inverse_mass: Array) -> Prepared:
        """Acts on pinned vertices too; `Pin` resets them."""
        return _Gravity(self.g)


@pytree
@dataclasses.dataclass(frozen=True)
class _Gravity(Prepared):
    g: float = dataclasses.field(metadata={"static": True})

    def reshaped(self, rest: Rest) -> Prepared:
        return self

    def accelerate(self, velocity: Array, context: None, h: float) -> Array:
        return velocity.at[:, 1].add(-self.g * h)
