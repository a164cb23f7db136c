"""Bending: quadratic isometric energy, the mean curvature at vertices, flat at rest."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ...geometry import greedy_colours, mesh_edges
from ...typing import pytree
from .._assembly import Assembly, float32
from .._effect import Clock, Effect, Prepared


@dataclasses.dataclass(frozen=True)
class Bend(Effect):
    """``E = 1/2 sum_v k / A_v |sum_j L_vj x_j|^2`` over interior vertices.

    ``L`` is the cotangent Laplacian of the rest shape and ``A_v`` the Voronoi
    area of a vertex: for isometric deformation the sum is the mean curvature vector
    times the area, so a cylinder stores ``k kappa^2 / 2`` an area however the mesh is
    cut. The energy is quadratic: its Hessian is constant. Cloth is flat at rest, also
    where it is worn round a sleeve; free edges bend with what is beside them.

    References:
        Wardetzky, Bergou, Harmon, Zorin and Grinspun, Discrete quadratic curvature
        energies (2007), the conforming form of section 3. Its hinge form (Bergou et
        al. 2006) counts a cylinder 1.5 times on equilateral triangles and 3 times on a
        right-angled grid, which `tests` show.
    """

    def prepare(self, assembly: Assembly, inverse_mass: Array) -> Prepared:
        """Colours the stars of vertices so that a Gauss-Seidel sweep runs by groups."""
        star, coefficient, area = vertex_stencils(assembly.rest, assembly.faces)
        usable = np.flatnonzero(area > 1e-10)
        star, coefficient, area = star[usable], coefficient[usable], area[usable]
        of_vertex = np.zeros(len(assembly.rest))
        of_vertex[assembly.faces] = assembly.bend[:, None]
        k = of_vertex[usable] / area
        w = np.append(np.asarray(inverse_mass), 0.0)
        count = len(assembly.rest)
        # Stars have different sizes. What is missing points past the end, each place
        # to another row: it is read as anything, weighed by zero and never written.
        missing = star < 0
        far = np.where(missing, count + np.cumsum(missing.ravel()).reshape(star.shape), star)
        groups = []
        for members in _colours(star, count):
            index, c = far[members], coefficient[members]
            push = w[np.minimum(index, count)] * c
            groups.append(
                _Group(
                    jnp.asarray(index.astype(np.int32)),
                    float32(c)[:, :, None, None],
                    float32(push)[:, :, None, None],
                    float32((push * c).sum(axis=1))[:, None, None],
                    float32(1.0 / np.maximum(k[members], 1e-12))[:, None, None],
                )
            )
        return _Bend(tuple(groups))


def vertex_stencils(
    x: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> tuple[
    Int[np.ndarray, "vertices k"], Float[np.ndarray, "vertices k"], Float[np.ndarray, " vertices"]
]:
    """Stars of vertices (itself first, -1 for none), cotangent weights, and areas [m^2].

    The area is zero where there is no stencil: at boundaries and isolated vertices.
    """
    count = len(x)
    edges = mesh_edges(faces)
    weight = np.zeros(len(edges.vertices))
    for k in range(3):
        a, b, c = (x[faces[:, (k + i) % 3]] for i in range(3))
        u, v = b - a, c - a
        sine = np.linalg.norm(np.cross(u, v), axis=1)
        # A needle's cotangent is bounded, or one triangle would outweigh all others.
        cot = np.clip(np.einsum("ij,ij->i", u, v) / np.maximum(sine, 1e-12), -5.0, 5.0)
        np.add.at(weight, edges.of_face[:, k], 0.5 * cot)
    area = _voronoi_areas(x, faces)
    rim = np.zeros(count, bool)
    rim[np.unique(edges.vertices[edges.count != 2])] = True
    rim[np.setdiff1d(np.arange(count), faces)] = True
    ends = np.concatenate([edges.vertices, edges.vertices[:, ::-1]])
    both = np.concatenate([weight, weight])
    order = np.lexsort((ends[:, 1], ends[:, 0]))
    ends, both = ends[order], both[order]
    begin = np.searchsorted(ends[:, 0], np.arange(count))
    place = np.arange(len(ends)) - begin[ends[:, 0]] + 1
    width = int(place.max()) + 1 if len(ends) else 1
    star = np.full((count, width), -1)
    star[:, 0] = np.arange(count)
    value = np.zeros((count, width))
    star[ends[:, 0], place] = ends[:, 1]
    value[ends[:, 0], place] = both
    value[:, 0] = -value.sum(axis=1)
    return star, value, np.where(rim, 0.0, area)


def _voronoi_areas(
    x: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> Float[np.ndarray, " vertices"]:
    """Mixed Voronoi areas [m^2] (Meyer et al. 2003): exact on grids, never negative."""
    corner = [x[faces[:, k]] for k in range(3)]
    side = [corner[(k + 2) % 3] - corner[(k + 1) % 3] for k in range(3)]
    squared = np.stack([np.einsum("ij,ij->i", s, s) for s in side], axis=1)
    twice = np.linalg.norm(np.cross(side[0], side[1]), axis=1)
    dot = np.stack(
        [-np.einsum("ij,ij->i", side[(k + 1) % 3], side[(k + 2) % 3]) for k in range(3)], axis=1
    )
    part = squared * dot / np.maximum(twice, 1e-12)[:, None] / 8
    blunt = dot < 0
    share = np.empty_like(part)
    for k in range(3):
        smooth = part[:, (k + 1) % 3] + part[:, (k + 2) % 3]
        share[:, k] = np.where(
            blunt.any(axis=1), np.where(blunt[:, k], twice / 4, twice / 8), smooth
        )
    area = np.zeros(len(x))
    np.add.at(area, faces, share)
    return area


def _colours(star: Int[np.ndarray, "stars k"], count: int) -> list[Int[np.ndarray, " n"]]:
    """Groups of stars that share no vertex; a missing corner is shared by nobody."""
    missing = star < 0
    own = np.where(missing, count + np.cumsum(missing.ravel()).reshape(star.shape), star)
    return greedy_colours(own, int(own.max(initial=0)) + 1)


@pytree
@dataclasses.dataclass(frozen=True)
class _Group:
    index: Int[Array, "stars k"]
    coefficient: Float[Array, "stars k 1 1"]
    push: Float[Array, "stars k 1 1"]
    inertia: Float[Array, "stars 1 1"]
    compliance: Float[Array, "stars 1 1"]


@pytree
@dataclasses.dataclass(frozen=True)
class _Bend(Prepared):
    elastic = True
    groups: tuple[_Group, ...]

    def begin(
        self, base: Array, start: None, end: None, clock: Clock, memory: Any
    ) -> tuple[Array, ...]:
        # Coefficients sum to zero: differences keep the sum exact far from the origin.
        out = []
        for g in self.groups:
            rows = base.at[g.index].get(mode="clip")
            out.append(jnp.sum(g.coefficient * (rows - rows[:, :1]), axis=1))
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
            rows = d.at[g.index].get(mode="clip")
            curvature = flat + jnp.sum(g.coefficient * rows, axis=1)
            move = curvature / (g.inertia + g.compliance / (h * h))
            rows = rows - g.push * move[:, None]
            d = d.at[g.index].set(rows, mode="drop", unique_indices=True)
        return d

    def energy(self, displacement: Array, context: tuple[Array, ...]) -> Array:
        total = jnp.zeros(displacement.shape[2:], displacement.dtype)
        for g, flat in zip(self.groups, context, strict=True):
            rows = displacement.at[g.index].get(mode="clip")
            curvature = flat + jnp.sum(g.coefficient * rows, axis=1)
            total = total + 0.5 * jnp.sum(curvature**2 / g.compliance, axis=(0, 1))
        return total

    def _pairs(self) -> tuple[np.ndarray, np.ndarray]:
        pairs, values = [np.zeros((0, 2), np.int64)], [np.zeros(0)]
        for g in self.groups:
            index, c = np.asarray(g.index), np.asarray(g.coefficient)[:, :, 0, 0]
            k = 1.0 / np.asarray(g.compliance)[:, 0, 0]
            for a in range(index.shape[1]):
                for b in range(index.shape[1]):
                    there = (c[:, a] != 0) & (c[:, b] != 0)
                    pairs.append(np.column_stack([index[there, a], index[there, b]]))
                    values.append((k * c[:, a] * c[:, b])[there])
        return np.concatenate(pairs), np.concatenate(values)

    def coupled(self) -> Int[np.ndarray, "blocks 2"]:
        return self._pairs()[0]

    def constant_stiffness(self) -> Float[np.ndarray, " blocks"]:
        return self._pairs()[1]
