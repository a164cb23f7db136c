"""Pins: vertices that move with the skin beneath them."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from ...typing import pytree
from .._assembly import Assembly, float32
from .._effect import Attached, Clock, Effect, Placed, Prepared


@dataclasses.dataclass(frozen=True)
class Pin(Effect):
    """Pinned vertices of each garment stand exactly where skinning puts them."""

    def prepare(self, assembly: Assembly, inverse_mass: Array) -> Prepared:
        """Takes the garments' own pins."""
        rows = np.flatnonzero(assembly.pinned)
        attached = Attached(
            float32(assembly.rest[rows]),
            float32(np.zeros((len(rows), 3))),
            float32(assembly.weights[rows]),
        )
        return _Pin(jnp.asarray(rows.astype(np.int32)), attached)


@pytree
@dataclasses.dataclass(frozen=True)
class _Pin(Prepared):
    holds = True
    index: Int[Array, " pins"]
    skin: Attached

    @property
    def attached(self) -> Attached:
        return self.skin

    def begin(
        self, base: Array, start: Placed, end: Placed, clock: Clock, memory: Any
    ) -> tuple[Array, Array]:
        return start.points - base[self.index], end.points - start.points

    def project(
        self,
        displacement: Array,
        start: Array,
        context: tuple[Array, Array],
        progress: Array,
        step: tuple[float, float],
    ) -> Array:
        where, way = context
        return displacement.at[self.index].set(where + progress * way, unique_indices=True)
