"""Damping: exponential decay of velocities."""

import dataclasses
import math

from jaxtyping import Array

from ...errors import check_numbers
from ...typing import pytree
from .._assembly import Assembly
from .._effect import Effect, Prepared, Rest


@dataclasses.dataclass(frozen=True)
class Damping(Effect):
    """``dv/dt = -rate v``: each step multiplies velocities by the exact decay over its length.

    Attributes:
        rate: Decay rate [1/s]. One per second corresponds to light cotton that moves at
            1 m/s in still air (drag 0.5 rho c v with c about 1 over 0.15 kg/m^2, averaged
            over directions).
    """

    rate: float = 1.0

    def __post_init__(self) -> None:
        check_numbers(self, "rate", zero=True)

    def idle(self, assembly: Assembly) -> bool:
        """At rate 0."""
        return self.rate == 0.0

    def prepare(self, assembly: Assembly, inverse_mass: Array) -> Prepared:
        """Needs nothing from the scene."""
        return _Damping(self.rate)


@pytree
@dataclasses.dataclass(frozen=True)
class _Damping(Prepared):
    rate: float = dataclasses.field(metadata={"static": True})

    def reshaped(self, rest: Rest) -> Prepared:
        return self

    def accelerate(self, velocity: Array, context: None, h: float) -> Array:
        return velocity * math.exp(-self.rate * h)
