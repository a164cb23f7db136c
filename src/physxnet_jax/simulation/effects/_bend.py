"""Bending: quadratic isometric energy over hinges, flat at rest."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ...typing import pytree
from .._assembly import Assembly
from .._effect import Clock, Effect, Prepared
from ._colored import ColorGroup, bundled, color_groups, column, corner_pairs, sweep
from ._hinge import bending_hinges


@dataclasses.dataclass(frozen=True)
class Bend(Effect):
    """``E = 1/2 sum k/(A_1 + A_2) |sum_i c_i x_i|^2`` over interior edges.

    The coefficients ``c`` come from cotangents of the rest shape, so the energy is
    quadratic and its Hessian constant; see `bending_hinges` for its scale.
    Cloth is flat at rest, even where the garment is curved, as in a sleeve.

    References:
        Bergou, Wardetzky, Harmon, Zorin and Grinspun, A quadratic bending model for
        inextensible surfaces (2006), equation 5.
    """

    def prepare(self, assembly: Assembly, inverse_mass: Array) -> Prepared:
        """Colours the hinges so that a Gauss-Seidel sweep runs colour by colour."""
        h = bending_hinges(assembly)
        quads, coefficients, k = h.corners, h.coefficient, h.stiffness
        w = np.asarray(inverse_mass)
        order, parts = color_groups(quads, len(assembly.rest))
        index, c = quads[order].astype(np.int32), coefficients[order]
        hinges = _Hinges(
            tuple(jnp.asarray(index[:, i]) for i in range(4)),
            tuple(column(c[:, i]) for i in range(4)),
            tuple(column(w[index[:, i]] * c[:, i]) for i in range(4)),
            column((w[index] * c * c).sum(axis=1)),
            column(1.0 / np.maximum(k[order], 1e-12)),
        )
        return _Bend(hinges, parts)


@pytree
@dataclasses.dataclass(frozen=True)
class _Hinges:
    index: tuple[Int[Array, " members"], ...]
    coefficient: tuple[Float[Array, "members 1 1"], ...]
    weighted_coefficient: tuple[Float[Array, "members 1 1"], ...]
    inertia: Float[Array, "members 1 1"]
    compliance: Float[Array, "members 1 1"]


@pytree
@dataclasses.dataclass(frozen=True)
class _Bend(Prepared):
    elastic = True
    materials = ("bend",)
    hinges: _Hinges
    color_groups: tuple[ColorGroup, ...]

    def rescaled(self, factors: Mapping[str, Any]) -> Prepared:
        if "bend" not in factors:
            return self
        h = self.hinges
        softer = dataclasses.replace(h, compliance=h.compliance / factors["bend"])
        return dataclasses.replace(self, hinges=softer)

    def begin(self, base: Array, start: None, end: None, clock: Clock, state: Any) -> tuple:
        # The coefficients sum to zero: differences keep the sum exact far from the origin.
        h = self.hinges
        first = base[h.index[0]]
        flat = jnp.zeros_like(first)
        for c, i in zip(h.coefficient[1:], h.index[1:], strict=True):
            flat = flat + c * (base[i] - first)
        known = (flat, h.coefficient, h.weighted_coefficient, h.inertia, h.compliance)
        return flat, bundled(self.color_groups, h.index, known)

    def project(
        self,
        displacement: Array,
        start: Array,
        context: tuple,
        progress: Array,
        step: tuple[float, float],
    ) -> Array:
        h = step[0]

        def move(rows: list[Array], known: tuple) -> list[Array]:
            curvature, coefficient, weighted_coefficient, inertia, compliance = known
            for c, row in zip(coefficient, rows, strict=True):
                curvature = curvature + c * row
            multiplier = curvature / (inertia + compliance / (h * h))
            return [row - p * multiplier for p, row in zip(weighted_coefficient, rows, strict=True)]

        return sweep(displacement, context[1], move)

    def energy(self, displacement: Array, context: tuple) -> Array:
        h, curvature = self.hinges, context[0]
        for c, i in zip(h.coefficient, h.index, strict=True):
            curvature = curvature + c * displacement[i]
        return 0.5 * jnp.sum(curvature**2 / h.compliance, axis=(0, 1))

    def coupled(self) -> Int[np.ndarray, "blocks 2"]:
        return corner_pairs(self.hinges.index)

    def constant_stiffness(self) -> Float[Array, " blocks"]:
        h = self.hinges
        c = [x[:, 0, 0] for x in h.coefficient]
        k = 1.0 / h.compliance[:, 0, 0]
        return jnp.concatenate([k * a * b for a in c for b in c])
