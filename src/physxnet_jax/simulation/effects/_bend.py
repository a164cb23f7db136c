"""Bending: quadratic isometric energy over hinges, flat at rest."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ...geometry import greedy_colours
from ...typing import pytree
from .._assembly import Assembly, float32
from .._effect import Clock, Effect, Prepared
from ._coloured import corner_pairs, joined, scatter_rows
from ._hinge import bending_hinges


@dataclasses.dataclass(frozen=True)
class Bend(Effect):
    """``E = 1/2 sum k/(A_1 + A_2) |sum_i c_i x_i|^2`` over interior edges.

    The coefficients ``c`` come from cotangents of the rest shape, so the energy is
    quadratic and its Hessian constant; see `bending_hinges` for its scale.
    Cloth is flat at rest, also where it is worn round a sleeve.

    References:
        Bergou, Wardetzky, Harmon, Zorin and Grinspun, A quadratic bending model for
        inextensible surfaces (2006), equation 5.
    """

    def prepare(self, assembly: Assembly, inverse_mass: Array) -> Prepared:
        """Colours the hinges so that a Gauss-Seidel sweep runs group by group."""
        h = bending_hinges(assembly)
        quads, coefficients, k = h.corners, h.coefficient, h.stiffness
        w = np.asarray(inverse_mass)
        groups = []
        for members in greedy_colours(quads, len(assembly.rest)):
            index, c = quads[members], coefficients[members]
            groups.append(
                _Group(
                    tuple(jnp.asarray(index[:, i]) for i in range(4)),
                    tuple(float32(c[:, i][:, None, None]) for i in range(4)),
                    tuple(float32((w[index[:, i]] * c[:, i])[:, None, None]) for i in range(4)),
                    float32(((w[index] * c * c).sum(axis=1))[:, None, None]),
                    float32((1.0 / np.maximum(k[members], 1e-12))[:, None, None]),
                )
            )
        return _Bend(tuple(groups))


@pytree
@dataclasses.dataclass(frozen=True)
class _Group:
    index: tuple[Int[Array, " members"], ...]
    coefficient: tuple[Float[Array, "members 1 1"], ...]
    push: tuple[Float[Array, "members 1 1"], ...]
    inertia: Float[Array, "members 1 1"]
    compliance: Float[Array, "members 1 1"]


@pytree
@dataclasses.dataclass(frozen=True)
class _Bend(Prepared):
    elastic = True
    groups: tuple[_Group, ...]

    def rescaled(self, factors: Mapping[str, Any]) -> Prepared:
        if "bend" not in factors:
            return self
        softer = [
            dataclasses.replace(g, compliance=g.compliance / factors["bend"]) for g in self.groups
        ]
        return dataclasses.replace(self, groups=tuple(softer))

    def begin(
        self, base: Array, start: None, end: None, clock: Clock, memory: Any
    ) -> tuple[Array, ...]:
        # The coefficients sum to zero: differences keep the sum exact far from the origin.
        out = []
        for g in self.groups:
            first = base[g.index[0]]
            total = jnp.zeros_like(first)
            for i in range(1, 4):
                total = total + g.coefficient[i] * (base[g.index[i]] - first)
            out.append(total)
        return tuple(out)

    def project(
        self,
        displacement: Array,
        start: Array,
        context: tuple[Array, ...],
        progress: Array,
        step: tuple[float, float],
    ) -> Array:
        h = step[0]
        d = displacement
        for g, flat in zip(self.groups, context, strict=True):
            rows = [d[i] for i in g.index]
            curvature = flat
            for c, row in zip(g.coefficient, rows, strict=True):
                curvature = curvature + c * row
            move = curvature / (g.inertia + g.compliance / (h * h))
            rows = [row - p * move for p, row in zip(g.push, rows, strict=True)]
            d = scatter_rows(d, list(g.index), rows)
        return d

    def energy(self, displacement: Array, context: tuple[Array, ...]) -> Array:
        if not self.groups:
            return jnp.zeros(displacement.shape[2:], displacement.dtype)
        g, curvature = joined(self.groups), jnp.concatenate(context)
        for c, i in zip(g.coefficient, g.index, strict=True):
            curvature = curvature + c * displacement[i]
        return 0.5 * jnp.sum(curvature**2 / g.compliance, axis=(0, 1))

    def coupled(self) -> Int[np.ndarray, "blocks 2"]:
        none = np.zeros((0, 2), np.int64)
        return corner_pairs(joined(self.groups).index) if self.groups else none

    def constant_stiffness(self) -> Float[np.ndarray, " blocks"]:
        if not self.groups:
            return np.zeros(0)
        g = joined(self.groups)
        c = [np.asarray(x)[:, 0, 0] for x in g.coefficient]
        k = 1.0 / np.asarray(g.compliance)[:, 0, 0]
        return np.concatenate([k * a * b for a in c for b in c])
