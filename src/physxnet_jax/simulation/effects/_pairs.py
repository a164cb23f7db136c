"""Contact of cloth with cloth: separation and friction of vertices and triangles."""

import dataclasses
from typing import Any, Protocol, runtime_checkable

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ...geometry import closest_barycentric, materialize
from ...typing import pytree
from .._effect import Clock, Prepared, Step
from ._gather import gather_corners, nearest_face

# Pairs that are too close approach their gap within this time [s].
_SETTLING = 0.1


@pytree
@dataclasses.dataclass(frozen=True)
class Pairs:
    """Vertices and the closest points of triangles, for one contact interval.

    Attributes:
        vertex: Rows of the vertices, shape [pairs, batch].
        corners: Rows of the triangles' corners, shape [3, pairs, batch].
        weights: Barycentric weights of the closest points, shape [3, pairs, batch].
        normal: Directions in which the vertices are moved, shape [pairs, 3, batch].
        height: Heights along the normals at the start [m], shape [pairs, 1, batch].
        active: 1 for active pairs, else 0, shape [pairs, 1, batch].
    """

    vertex: Int[Array, "pairs batch"]
    corners: Int[Array, "3 pairs batch"]
    weights: Float[Array, "3 pairs batch"]
    normal: Float[Array, "pairs 3 batch"]
    height: Float[Array, "pairs 1 batch"]
    active: Float[Array, "pairs 1 batch"]

    def members(self) -> tuple[list[Array], list[Array]]:
        """Rows of the vertex and the three corners, and their coefficients in the distance."""
        shares = [jnp.ones_like(self.weights[0]), *(-self.weights)]
        return [self.vertex, *self.corners], shares

    def motion(self, displacement: Float[Array, "vertices 3 batch"]) -> Array:
        """Displacements of vertices relative to their points [m], shape [pairs, 3, batch]."""
        index, share = self.members()
        return sum(s[:, None] * rows_of(displacement, i) for i, s in zip(index, share, strict=True))  # pyright: ignore[reportReturnType]

    def heights(self, displacement: Float[Array, "vertices 3 batch"]) -> Array:
        """Heights after the displacements [m], shape [pairs, 1, batch]."""
        return self.height + jnp.sum(self.motion(displacement) * self.normal, axis=1, keepdims=True)


@pytree
@dataclasses.dataclass(frozen=True)
class Facing:
    """Context of cloth contact in a contact interval.

    Attributes:
        pairs: Vertices and the triangles that they face.
        clock: Start and length of the interval.
        state: Effect state for the next interval.
        watched: 1 for pairs in the diagnostics, active or not; if None, those are ``active``.
    """

    pairs: Pairs
    clock: Clock
    state: Any
    watched: Float[Array, "pairs 1 batch"] | None = None


@runtime_checkable
class Spacing(Protocol):
    """Settings of cloth contact: gap [m], friction [1], speed of separation [m/s]."""

    @property
    def gap(self) -> float: ...
    @property
    def friction(self) -> float: ...
    @property
    def leave(self) -> float: ...


class ClothContact(Prepared):
    """Base class of contact of cloth with cloth; `begin` of subclasses finds the pairs."""

    unilateral = True
    inverse_mass: Float[Array, "vertices 1 1"]
    law: Spacing

    def update_state(self, context: Facing) -> Any:
        return context.state

    def project(
        self,
        displacement: Array,
        start: Array,
        context: Facing,
        progress: Array,
        step: Step,
    ) -> Array:
        return separate_pairs(
            displacement, start, context.pairs, self.inverse_mass, self.law, context.clock, progress
        )


def rows_of(x: Float[Array, "vertices 3 batch"], index: Int[Array, "... batch"]) -> Array:
    """Rows of each batch member, shape [..., 3, batch]."""
    return jnp.swapaxes(_rows(x, index), -1, -2)


def _rows(x: Float[Array, "vertices 3 batch"], index: Int[Array, "... batch"]) -> Array:
    """`rows_of` with coordinates last: as they lie in memory, for a batch of one."""
    return jnp.swapaxes(x, 1, 2)[index, jnp.arange(x.shape[2])]


def closest_of(
    points: Float[Array, "pairs 3 batch"],
    x: Float[Array, "vertices 3 batch"],
    faces: Int[Array, "faces 3"],
    patch: Int[Array, "k pairs batch"],
) -> tuple[Array, Array]:
    """The closest of k triangles for each point: corners and weights, [3, pairs, batch]."""
    corners = jnp.moveaxis(faces[nearest_face(points, x, faces, patch)], -1, 0)
    tri = materialize(gather_corners(x, corners, axis=0))
    return corners, closest_barycentric(jnp.moveaxis(points, 1, 0), *tri)[0]


def foot_of(x: Float[Array, "vertices 3 batch"], corners: Array, weights: Array) -> Array:
    """Points on triangles, shape [pairs, 3, batch]."""
    return jnp.swapaxes(jnp.sum(weights[..., None] * _rows(x, corners), axis=0), 1, 2)


def wanted_height(
    height: Float[Array, "pairs 1 batch"], law: Spacing, time: Array
) -> Float[Array, "pairs 1 batch"]:
    """Height that pairs keep [m]: the gap, which those too close at the start approach with time.

    Args:
        height: Height at the start of the contact interval [m].
        law: Gap and speed of separation.
        time: Time since then [s].
    """
    speed = jnp.clip((law.gap - height) / _SETTLING, 0.0, law.leave)
    return jnp.minimum(law.gap, height + speed * time)


def separate_pairs(
    displacement: Float[Array, "vertices 3 batch"],
    start: Float[Array, "vertices 3 batch"],
    pairs: Pairs,
    inverse_mass: Float[Array, "vertices 1 1"],
    law: Spacing,
    clock: Clock,
    progress: Array,
) -> Array:
    """Displacements [m] after the separation of vertices and triangles.

    Pairs that are too close at the start of the contact interval separate within a tenth of a
    second, no faster than ``leave`` [m/s], so that tangled cloth comes apart without bursting. All
    pairs act at once, so their order doesn't matter. Where several share a vertex, each takes its
    part; momentum is conserved, as all four vertices of a pair take the same part.

    Args:
        displacement: Displacement since the start of the contact interval [m].
        start: Displacement at the start of the substep [m].
        pairs: Pairs of this interval.
        inverse_mass: Inverse masses of the vertices [1/kg].
        law: Gap, friction and speed of separation.
        clock: Start and length of the interval.
        progress: Fraction of the interval done.
    """
    lane = jnp.arange(displacement.shape[2])[None]
    index, share = pairs.members()
    mass = [inverse_mass[i, 0, 0][:, None] for i in index]
    n = pairs.normal
    relative = pairs.motion(displacement)
    height = pairs.heights(displacement)
    target = wanted_height(pairs.height, law, progress * clock.length)
    depth = jnp.maximum(target - height, 0.0) * pairs.active
    inertia = sum(s[:, None] ** 2 * w for s, w in zip(share, mass, strict=True))
    lift = depth / (inertia + 1e-9)
    move = lift * n
    if law.friction:
        slide = relative - pairs.motion(start)
        slide = slide - jnp.sum(slide * n, axis=1, keepdims=True) * n
        length = jnp.sqrt(jnp.sum(slide * slide, axis=1, keepdims=True) + 1e-18)
        hold = jnp.minimum(1.0, law.friction * depth / length) / (inertia + 1e-9)
        move = move - jnp.where(depth > 0, hold, 0.0) * slide
    total = jnp.zeros_like(displacement)
    count = jnp.zeros_like(displacement[:, :1])
    acts = (depth > 0).astype(displacement.dtype)
    for i, s in zip(index, share, strict=True):
        count = count.at[i, 0, lane].add((jnp.abs(s)[:, None] * acts)[:, 0])
    most = jnp.ones_like(pairs.height[:, 0])
    for i in index:
        most = jnp.maximum(most, count[i, 0, lane])
    move = move / most[:, None]
    for i, s, w in zip(index, share, mass, strict=True):
        total = total.at[i, :, lane].add(jnp.moveaxis(s[:, None] * w * move, 1, 2))
    return displacement + total


def side_normal(x: Float[Array, "vertices 3 batch"], corners: Int[Array, "3 pairs batch"]) -> Array:
    """Unit normals of triangles, shape [pairs, 3, batch]; zero for triangles without area."""
    a, b, c = (rows_of(x, i) for i in corners)
    n = jnp.cross(b - a, c - a, axis=1)
    return n / jnp.sqrt(jnp.sum(n * n, axis=1, keepdims=True) + 1e-20)


def smooth_normals(
    x: Float[Array, "vertices 3 batch"], faces: Int[Array, "faces 3"]
) -> Float[Array, "vertices 3 batch"]:
    """Unit normals of vertices, weighted by the areas of their triangles."""
    a, b, c = (x[faces[:, i]] for i in range(3))
    n = jnp.repeat(jnp.cross(b - a, c - a, axis=1), 3, axis=0)
    n = jnp.zeros_like(x).at[faces.reshape(-1)].add(n)
    return n / jnp.sqrt(jnp.sum(n * n, axis=1, keepdims=True) + 1e-20)


def towards(
    offset: Float[Array, "pairs 3 batch"], outwards: Float[Array, "pairs 3 batch"]
) -> Float[Array, "pairs 3 batch"]:
    """Unit directions of offsets from a surface, turned to its outer side.

    Where a point lies on the surface, the direction is the surface's normal ``outwards``.
    """
    length = jnp.sqrt(jnp.sum(offset * offset, axis=1, keepdims=True) + 1e-18)
    side = jnp.where(jnp.sum(offset * outwards, axis=1, keepdims=True) < 0, -1.0, 1.0)
    outwards = outwards / jnp.sqrt(jnp.sum(outwards * outwards, axis=1, keepdims=True) + 1e-20)
    return jnp.where(length > 1e-5, side.astype(offset.dtype) * offset / length, outwards)
