"""Bending: quadratic isometric energy over hinges, flat at rest."""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ...geometry import greedy_colours, hinges
from ...typing import pytree
from .._assembly import Assembly, float32
from .._effect import Effect, Prepared
from ._coloured import scatter_rows


@dataclasses.dataclass(frozen=True)
class Bend(Effect):
    """``E = 1/2 sum k 3/(A_1 + A_2) |sum_i c_i x_i|^2`` over interior edges.

    The coefficients ``c`` come from cotangents of the rest shape, so the energy is
    quadratic and, for isometric deformation, the integral of squared mean curvature.
    Cloth is flat at rest, also where it is worn round a sleeve.

    References:
        Bergou, Wardetzky, Harmon, Zorin and Grinspun, A quadratic bending model for
        inextensible surfaces (2006), equation 5.
    """

    def prepare(self, assembly: Assembly, inverse_mass: Array) -> Prepared:
        """Colours the hinges so that a Gauss-Seidel sweep runs group by group."""
        quads = hinges(assembly.faces)
        coefficients, area = _stencils(assembly.rest, quads)
        # Hinges beside a triangle without area have no meaningful stencil.
        usable = area > 1e-10
        quads, coefficients, area = quads[usable], coefficients[usable], area[usable]
        k = _hinge_stiffness(assembly, quads) * 3.0 / area
        w = np.asarray(inverse_mass)
        groups = []
        for members in greedy_colours(quads, len(assembly.rest)):
            index, c = quads[members], coefficients[members]
            groups.append(
                _Group(
                    tuple(jnp.asarray(index[:, i]) for i in range(4)),
                    tuple(float32(c[:, i])[:, None, None] for i in range(4)),
                    tuple(float32(w[index[:, i]] * c[:, i])[:, None, None] for i in range(4)),
                    float32((w[index] * c * c).sum(axis=1))[:, None, None],
                    float32(1.0 / np.maximum(k[members], 1e-12))[:, None, None],
                )
            )
        return _Bend(tuple(groups))


def _stencils(
    x: Float[np.ndarray, "vertices 3"], quads: Int[np.ndarray, "hinges 4"]
) -> tuple[Float[np.ndarray, "hinges 4"], Float[np.ndarray, " hinges"]]:
    """Coefficients of (a, b, left, right) and the area of both triangles."""
    a, b, p, q = (x[quads[:, i]] for i in range(4))

    def cot(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        sine = np.linalg.norm(np.cross(u, v), axis=1)
        return np.einsum("ij,ij->i", u, v) / np.maximum(sine, 1e-9)

    at_a = cot(b - a, p - a), cot(b - a, q - a)
    at_b = cot(a - b, p - b), cot(a - b, q - b)
    c = np.column_stack(
        [at_b[0] + at_b[1], at_a[0] + at_a[1], -at_a[0] - at_b[0], -at_a[1] - at_b[1]]
    )
    area = 0.5 * (
        np.linalg.norm(np.cross(b - a, p - a), axis=1)
        + np.linalg.norm(np.cross(b - a, q - a), axis=1)
    )
    return c, area


def _hinge_stiffness(
    assembly: Assembly, quads: Int[np.ndarray, "hinges 4"]
) -> Float[np.ndarray, " hinges"]:
    of_vertex = np.zeros(len(assembly.rest))
    of_vertex[assembly.faces] = assembly.bend[:, None]
    return of_vertex[quads[:, 0]]


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
    groups: tuple[_Group, ...]

    def begin(self, base: Array, start: None, end: None) -> tuple[Array, ...]:
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
