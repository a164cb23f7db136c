"""Pins: vertices that move with the skin."""

import dataclasses
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Int

from ...typing import pytree
from .._assembly import Assembly, float32
from .._effect import Clock, Effect, PosedPoints, Prepared, Rest, SkinnedPoints, Step


@dataclasses.dataclass(frozen=True)
class Pin(Effect):
    """Keeps the pinned vertices of each garment exactly at their skinned positions."""

    def idle(self, assembly: Assembly) -> bool:
        """Without a pinned vertex."""
        return not assembly.pinned.any()

    def prepare(self, assembly: Assembly, inverse_mass: Array) -> Prepared:
        """Collects the pinned vertices of all garments."""
        rows = np.flatnonzero(assembly.pinned)
        skinned_points = SkinnedPoints(
            float32(assembly.rest[rows]),
            float32(np.zeros((len(rows), 3))),
            float32(assembly.weights[rows]),
        )
        return _Pin(jax.device_put(rows.astype(np.int32)), skinned_points)


@pytree
@dataclasses.dataclass(frozen=True)
class _Pin(Prepared):
    kinematic = True
    index: Int[Array, " pins"]
    skin: SkinnedPoints

    @property
    def skinned_points(self) -> SkinnedPoints:
        return self.skin

    def reshaped(self, rest: Rest) -> Prepared:
        skin = dataclasses.replace(self.skin, rest=rest.cloth[self.index])
        return dataclasses.replace(self, skin=skin)

    def begin(
        self, base: Array, start: PosedPoints, end: PosedPoints, clock: Clock, state: Any
    ) -> tuple[Array, Array]:
        return start.points - base[self.index], end.points - start.points

    def project(
        self,
        displacement: Array,
        start: Array,
        context: tuple[Array, Array],
        progress: Array,
        step: Step,
    ) -> Array:
        offset, motion = context
        return displacement.at[self.index].set(offset + progress * motion, unique_indices=True)
