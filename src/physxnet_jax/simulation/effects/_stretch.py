"""Stretch: edges resist changes of length, compression less than tension."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ...errors import check_numbers
from ...geometry import mesh_edges
from ...typing import pytree
from .._assembly import Assembly, float32, norm
from .._effect import Clock, Effect, Prepared, Rest, Step
from ._colored import ColorGroup, bundled, color_groups, column, directed, sweep
from ._strain_report import strain_report


@dataclasses.dataclass(frozen=True)
class Stretch(Effect):
    """Springs along edges: ``E = 1/2 sum k_e (|x_a - x_b| - L_e)^2``.

    With ``k_e = Y A_e / L_e^2``, where ``A_e`` is the area of the triangles at the edge,
    a regular mesh is as stiff as a sheet of the fabric's modulus ``Y`` [N/m].

    Attributes:
        compression: Stiffness in compression relative to that in tension [1]: threads
            buckle below the size of a triangle.

    References:
        Macklin, Mueller and Chentanez, XPBD (2016), equation 18; van Gelder,
        Approximate simulation of elastic membranes by triangulated spring meshes
        (1998).
    """

    compression: float = 0.2

    def __post_init__(self) -> None:
        check_numbers(self, "compression")

    def prepare(self, assembly: Assembly, inverse_mass: Array) -> Prepared:
        """Colours the edges so that a Gauss-Seidel sweep runs colour by colour."""
        x, f = assembly.rest, assembly.faces
        edges = mesh_edges(f)
        length = np.linalg.norm(x[edges.vertices[:, 0]] - x[edges.vertices[:, 1]], axis=1)
        area = 0.5 * np.linalg.norm(
            np.cross(x[f[:, 1]] - x[f[:, 0]], x[f[:, 2]] - x[f[:, 0]]), axis=1
        )
        load = np.zeros(len(length))
        np.add.at(load, edges.of_face, (assembly.stretch * area)[:, None])
        opposite, modulus = _triangles(f, edges.of_face, assembly.stretch, len(length))
        # The bound gives edges of zero length the stiffest spring.
        stiffness = load / np.maximum(length, 1e-4) ** 2
        compliance = 1.0 / np.maximum(stiffness, 1e-6)
        w = np.asarray(inverse_mass)
        order, parts = color_groups(edges.vertices, len(x))
        a, b = edges.vertices[order].T.astype(np.int32)
        springs = _Springs(
            (jax.device_put(a), jax.device_put(b)),
            (column(w[a]), column(w[b])),
            column(length[order]),
            column(compliance[order]),
            jax.device_put(opposite[:, order]),
            float32(modulus[:, order]),
        )
        return _Stretch(springs, parts, 1.0 / self.compression)


def _triangles(
    faces: Int[np.ndarray, "faces 3"],
    of_face: Int[np.ndarray, "faces 3"],
    stretch: Float[np.ndarray, " faces"],
    count: int,
) -> tuple[Int[np.ndarray, "k edges"], Float[np.ndarray, "k edges"]]:
    """Corners opposite to edges in their triangles, and the moduli of these; 0 for padding."""
    edge = of_face.ravel()
    # Edge k of a face is opposite to its corner k.
    corner = faces.ravel()
    order = np.argsort(edge, kind="stable")
    edge, corner, modulus = edge[order], corner[order], np.repeat(stretch, 3)[order]
    place = np.arange(len(edge)) - np.searchsorted(edge, edge)
    shape = (int(place.max(initial=0)) + 1, count)
    opposite, moduli = np.zeros(shape, np.int32), np.zeros(shape)
    opposite[place, edge], moduli[place, edge] = corner, modulus
    return opposite, moduli


@pytree
@dataclasses.dataclass(frozen=True)
class _Springs:
    """Edges in the order of their colours.

    Attributes:
        ends: Vertices of each edge.
        weight: Their inverse masses [1/kg].
        length: Rest lengths [m].
        compliance: Inverse stiffnesses [m/N].
        opposite: Third corners of the triangles at each edge.
        modulus: Stiffness of their fabric [N/m], 0 for padding.
    """

    ends: tuple[Int[Array, " members"], Int[Array, " members"]]
    weight: tuple[Float[Array, "members 1 1"], Float[Array, "members 1 1"]]
    length: Float[Array, "members 1 1"]
    compliance: Float[Array, "members 1 1"]
    opposite: Int[Array, "k members"]
    modulus: Float[Array, "k members"]


@pytree
@dataclasses.dataclass(frozen=True)
class _Stretch(Prepared):
    elastic = True
    springs: _Springs
    color_groups: tuple[ColorGroup, ...]
    softer: float = dataclasses.field(metadata={"static": True})

    materials = ("stretch",)

    def rescaled(self, factors: Mapping[str, Any]) -> Prepared:
        if "stretch" not in factors:
            return self
        s = self.springs
        softer = dataclasses.replace(
            s,
            compliance=s.compliance / factors["stretch"],
            modulus=s.modulus * factors["stretch"],
        )
        return dataclasses.replace(self, springs=softer)

    def reshaped(self, rest: Rest) -> Prepared:
        s = self.springs
        a, b = (rest.cloth[i] for i in s.ends)
        across = rest.cloth[s.opposite] - a[None]
        area = 0.5 * norm(jnp.cross((b - a)[None], across))
        length = norm(b - a)
        load = jnp.sum(s.modulus * area, axis=0)
        compliance = 1.0 / jnp.maximum(load / jnp.maximum(length, 1e-4) ** 2, 1e-6)
        springs = dataclasses.replace(
            s,
            weight=tuple(rest.inverse_mass[i][:, None, None] for i in s.ends),
            length=length[:, None, None],
            compliance=compliance[:, None, None],
        )
        return dataclasses.replace(self, springs=springs)

    def begin(self, base: Array, start: None, end: None, clock: Clock, state: Any) -> tuple:
        s = self.springs
        edge = base[s.ends[1]] - base[s.ends[0]]
        known = (edge, s.weight, s.length, s.compliance)
        return edge, bundled(self.color_groups, s.ends, known)

    def project(
        self,
        displacement: Array,
        start: Array,
        context: tuple,
        progress: Array,
        step: Step,
    ) -> Array:
        h = step.length

        def move(rows: list[Array], known: tuple) -> list[Array]:
            (da, db), (edge, (wa, wb), rest, compliance) = rows, known
            span = directed(edge + (db - da), rest)
            length = jnp.sqrt(jnp.sum(span * span, axis=1, keepdims=True) + 1e-18)
            excess = length - rest
            alpha = compliance * jnp.where(excess < 0, self.softer, 1.0) / (h * h)
            correction = span * (excess / (length * (wa + wb + alpha)))
            return [da + wa * correction, db - wb * correction]

        return sweep(displacement, context[1], move)

    def _spans(self, displacement: Array, context: tuple) -> Array:
        a, b = self.springs.ends
        return context[0] + (displacement[b] - displacement[a])

    def energy(self, displacement: Array, context: tuple) -> Array:
        s, span = self.springs, self._spans(displacement, context)
        excess = jnp.sqrt(jnp.sum(span * span, axis=1, keepdims=True) + 1e-18) - s.length
        alpha = s.compliance * jnp.where(excess < 0, self.softer, 1.0)
        return 0.5 * jnp.sum(excess**2 / alpha, axis=(0, 1))

    def coupled(self) -> Int[np.ndarray, "blocks 2"]:
        a, b = (np.asarray(end) for end in self.springs.ends)
        return np.concatenate([np.column_stack(p) for p in ((a, a), (b, b), (a, b), (b, a))])

    def hessian(self, displacement: Array, context: tuple) -> Array:
        """Stiffness along the edge, and across it only in tension: positive semidefinite."""
        s = self.springs
        eye = jnp.eye(3, dtype=displacement.dtype)[None, None]
        span = jnp.swapaxes(self._spans(displacement, context), 1, 2)
        length = jnp.sqrt(jnp.sum(span * span, axis=2, keepdims=True) + 1e-18)[..., None]
        rest = s.length[..., None]
        k = 1.0 / (s.compliance[..., None] * jnp.where(length < rest, self.softer, 1.0))
        n = span / length[..., 0]
        along = n[..., :, None] * n[..., None, :]
        taut = jnp.maximum(1.0 - rest / length, 0.0)
        block = k * (along + taut * (eye - along))
        return jnp.concatenate([block, block, -block, -block])

    def diagnose(self, displacement: Array, context: tuple) -> dict[str, Array]:
        span, rest = self._spans(displacement, context), self.springs.length[:, 0]
        every = (jnp.sqrt(jnp.sum(span * span, axis=1)) - rest) / jnp.maximum(rest, 1e-4)
        return strain_report(every)
