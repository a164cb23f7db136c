"""Stretch: edges resist a change of length, less so when compressed."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ...geometry import greedy_colours, mesh_edges
from ...typing import pytree
from .._assembly import Assembly, float32
from .._effect import Clock, Effect, Prepared
from ._coloured import joined, scatter_rows


@dataclasses.dataclass(frozen=True)
class Stretch(Effect):
    """Springs along edges: ``E = 1/2 sum k_e (|x_a - x_b| - L_e)^2``.

    ``k_e = Y A_e / L_e^2`` with ``A_e`` the area of the triangles beside the edge
    makes a regular mesh as stiff as a sheet of modulus ``Y`` [N/m] (the fabric's).

    Attributes:
        compression: Stiffness against shortening as a share of that against
            lengthening: threads buckle below the size of a triangle.

    References:
        Macklin, Mueller and Chentanez, XPBD (2016), equation 18; van Gelder,
        Approximate simulation of elastic membranes by triangulated spring meshes
        (1998).
    """

    compression: float = 0.2

    def prepare(self, assembly: Assembly, inverse_mass: Array) -> Prepared:
        """Colours the edges so that a Gauss-Seidel sweep runs group by group."""
        x, f = assembly.rest, assembly.faces
        edges = mesh_edges(f)
        length = np.linalg.norm(x[edges.vertices[:, 0]] - x[edges.vertices[:, 1]], axis=1)
        area = 0.5 * np.linalg.norm(
            np.cross(x[f[:, 1]] - x[f[:, 0]], x[f[:, 2]] - x[f[:, 0]]), axis=1
        )
        load = np.zeros(len(length))
        np.add.at(load, edges.of_face, (assembly.stretch * area)[:, None])
        # Edges of length zero keep their ends together with the stiffest spring there is.
        stiffness = load / np.maximum(length, 1e-4) ** 2
        compliance = 1.0 / np.maximum(stiffness, 1e-6)
        w = np.asarray(inverse_mass)
        groups = []
        for members in greedy_colours(edges.vertices, len(x)):
            a, b = edges.vertices[members].T
            groups.append(
                _Group(
                    jnp.asarray(a),
                    jnp.asarray(b),
                    float32(length[members][:, None, None]),
                    float32(compliance[members][:, None, None]),
                    float32(w[a][:, None, None]),
                    float32(w[b][:, None, None]),
                )
            )
        return _Stretch(tuple(groups), 1.0 / self.compression)


@pytree
@dataclasses.dataclass(frozen=True)
class _Group:
    a: Int[Array, " members"]
    b: Int[Array, " members"]
    length: Float[Array, "members 1 1"]
    compliance: Float[Array, "members 1 1"]
    weight_a: Float[Array, "members 1 1"]
    weight_b: Float[Array, "members 1 1"]


@pytree
@dataclasses.dataclass(frozen=True)
class _Stretch(Prepared):
    elastic = True
    groups: tuple[_Group, ...]
    softer: float = dataclasses.field(metadata={"static": True})

    def rescaled(self, factors: Mapping[str, Any]) -> Prepared:
        if "stretch" not in factors:
            return self
        k = factors["stretch"]
        groups = [dataclasses.replace(g, compliance=g.compliance / k) for g in self.groups]
        return dataclasses.replace(self, groups=tuple(groups))

    def begin(
        self, base: Array, start: None, end: None, clock: Clock, memory: Any
    ) -> tuple[Array, ...]:
        return tuple(base[g.b] - base[g.a] for g in self.groups)

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
        for g, edge in zip(self.groups, context, strict=True):
            da, db = d[g.a], d[g.b]
            span = edge + (db - da)
            length = jnp.sqrt(jnp.sum(span * span, axis=1, keepdims=True) + 1e-18)
            excess = length - g.length
            alpha = g.compliance * jnp.where(excess < 0, self.softer, 1.0) / (h * h)
            move = span * (excess / (length * (g.weight_a + g.weight_b + alpha)))
            d = scatter_rows(d, [g.a, g.b], [da + g.weight_a * move, db - g.weight_b * move])
        return d

    def energy(self, displacement: Array, context: tuple[Array, ...]) -> Array:
        g, edge = joined(self.groups), jnp.concatenate(context)
        span = edge + (displacement[g.b] - displacement[g.a])
        excess = jnp.sqrt(jnp.sum(span * span, axis=1, keepdims=True) + 1e-18) - g.length
        alpha = g.compliance * jnp.where(excess < 0, self.softer, 1.0)
        return 0.5 * jnp.sum(excess**2 / alpha, axis=(0, 1))

    def coupled(self) -> Int[np.ndarray, "blocks 2"]:
        g = joined(self.groups)
        a, b = np.asarray(g.a), np.asarray(g.b)
        return np.concatenate([np.column_stack(p) for p in ((a, a), (b, b), (a, b), (b, a))])

    def hessian(self, displacement: Array, context: tuple[Array, ...]) -> Array:
        """Along the edge always, across it only in tension: so it stays positive."""
        g, edge = joined(self.groups), jnp.concatenate(context)
        eye = jnp.eye(3, dtype=displacement.dtype)[None, None]
        span = jnp.swapaxes(edge + (displacement[g.b] - displacement[g.a]), 1, 2)
        length = jnp.sqrt(jnp.sum(span * span, axis=2, keepdims=True) + 1e-18)[..., None]
        rest = g.length[..., None]
        k = 1.0 / (g.compliance[..., None] * jnp.where(length < rest, self.softer, 1.0))
        n = span / length[..., 0]
        along = n[..., :, None] * n[..., None, :]
        taut = jnp.maximum(1.0 - rest / length, 0.0)
        block = k * (along + taut * (eye - along))
        return jnp.concatenate([block, block, -block, -block])

    def diagnose(self, displacement: Array, context: tuple[Array, ...]) -> dict[str, Array]:
        g, edge = joined(self.groups), jnp.concatenate(context)
        span = edge + (displacement[g.b] - displacement[g.a])
        length = jnp.sqrt(jnp.sum(span * span, axis=1))
        every = (length - g.length[:, 0]) / jnp.maximum(g.length[:, 0], 1e-4)
        return {"strain_max": every.max(axis=0), "strain_p99": jnp.quantile(every, 0.99, axis=0)}
