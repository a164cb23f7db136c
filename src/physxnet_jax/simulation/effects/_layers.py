"""Contact between garments in layers, in the order of the scene."""

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.spatial import KDTree

from ...body import NUM_BODY_VERTICES
from ...errors import check_counts, check_numbers
from ...geometry import materialize, mesh_edges
from ...typing import pytree
from .._assembly import Assembly, float32
from .._effect import Clock, Effect, Prepared, Step
from ._gather import pick_nearest
from ._limbs import adjoining, limb_labels
from ._pairs import (
    ClothContact,
    Facing,
    Pairs,
    closest_of,
    foot_of,
    side_normal,
    smooth_normals,
    towards,
    wanted_height,
)

# Vertices farther than this from the other garment at rest never touch it [m].
_REACH = 0.25
# Vertices deeper than this on the wrong side aren't corrected [m].
_MAX_CORRECTED = 0.05
# Vertices on the wrong side are reported up to this depth [m].
_MAX_REPORTED = 0.25
# Vertices farther than this beyond the border of the other garment don't touch it [m].
_BORDER_TOLERANCE = 0.002


@dataclasses.dataclass(frozen=True)
class LayerContact(Effect):
    """Keeps each garment of a scene over the ones before it.

    Each vertex tracks the closest point of the other garment as `BodyContact` tracks the
    skin: the search starts at the previous result and walks over the surface. The order
    is known, so a vertex on the wrong side is moved back instead of being kept there, unless
    the layers face each other, as folds do.
    Vertices of the outer garment are tested against triangles of the inner one, and
    vertices of the inner one against triangles of the outer one. Of each pair only the vertex
    moves, by its share of the distance: the triangle's corners have pairs of their own.

    Attributes:
        gap: Distance kept between layers [m].
        friction: Coulomb coefficient between them [1].
        leave: Speed at which overlapping layers separate [m/s].
        hops: Steps of the walk per contact interval.
        ring: Number of vertices that each step compares.
        patch: Number of triangles around the nearest vertex that are compared exactly.

    References:
        Bridson, Fedkiw and Anderson, Robust treatment of collisions, contact and
        friction for cloth animation (2002), for vertex against triangle. That the order
        of layers replaces their history is specific to this package.
    """

    gap: float = 0.003
    friction: float = 0.3
    leave: float = 0.2
    hops: int = 2
    ring: int = 12
    patch: int = 10

    def __post_init__(self) -> None:
        check_numbers(self, "gap", "friction", "leave", zero=True)
        check_counts(self, "hops", "ring", "patch")

    def idle(self, assembly: Assembly) -> bool:
        """With a single garment."""
        return len(assembly.parts) < 3

    def prepare(self, assembly: Assembly, inverse_mass: Array) -> Prepared:
        """Builds tables of each garment's surface and the first vertex of each search."""
        x, parts = assembly.rest, assembly.parts
        label = limb_labels(assembly.weights, assembly.body)
        ring = np.zeros((len(x), self.ring), np.int32)
        patch = np.zeros((len(x), self.patch), np.int32)
        rim = np.zeros(len(x))
        skin = assembly.rest_body[:NUM_BODY_VERTICES]
        outwards = assembly.faces.copy()
        for i, j in zip(parts, parts[1:]):
            own = np.flatnonzero(((assembly.faces >= i) & (assembly.faces < j)).all(axis=1))
            f = assembly.faces[own]
            ring[i:j] = i + _nearest(x[i:j], x[i:j], self.ring)
            patch[i:j] = own[_nearest(x[f].mean(axis=1), x[i:j], self.patch)]
            edges = mesh_edges(f)
            rim[edges.vertices[edges.count == 1]] = 1.0
            n = np.cross(x[f[:, 1]] - x[f[:, 0]], x[f[:, 2]] - x[f[:, 0]])
            middle = x[f].mean(axis=1)
            away = middle - skin[KDTree(skin).query(middle)[1]]
            # Outwards is away from the skin.
            if np.einsum("ij,ij->", n, away) < 0:
                outwards[own] = f[:, ::-1]
        rows, start, side = [], [], []
        for a in range(len(parts) - 1):
            for b in range(len(parts) - 1):
                if a == b:
                    continue
                own_vertices = np.arange(parts[a], parts[a + 1])
                near = parts[b] + _nearest(x[parts[b] : parts[b + 1]], x[own_vertices], 1)[:, 0]
                in_reach = np.linalg.norm(x[near] - x[own_vertices], axis=1) < _REACH
                own_vertices, near = own_vertices[in_reach], near[in_reach]
                rows.append(own_vertices)
                start.append(near)
                side.append(np.full(len(own_vertices), 1.0 if a > b else -1.0))
        if not rows:
            rows, start, side = [np.zeros(0, int)], [np.zeros(0, int)], [np.zeros(0)]
        pair = _pairs_of(rows, len(x))
        return _Layers(
            jax.device_put(np.concatenate(rows).astype(np.int32)),
            jax.device_put(np.concatenate(start).astype(np.int32)),
            float32(np.concatenate(side)[:, None, None]),
            jax.device_put(ring.T),
            jax.device_put(patch.T),
            jax.device_put(outwards.astype(np.int32)),
            float32(rim),
            jax.device_put(label.astype(np.int32)),
            jax.device_put(adjoining()),
            jax.device_put(inverse_mass)[:, None, None],
            jax.device_put(np.maximum(pair, 0)),
            float32((pair >= 0)[..., None, None]),
            self,
        )


def _pairs_of(
    rows: Sequence[Int[np.ndarray, " _"]], vertices: int
) -> Int[np.ndarray, "others vertices"]:
    """Pairs of each vertex, of which it has at most one in each block of rows; -1 for none."""
    out = np.full((len(rows), vertices), -1, np.int32)
    first = np.cumsum([0, *(len(r) for r in rows)])
    for k, r in enumerate(rows):
        out[k, r] = first[k] + np.arange(len(r))
    # A garment has pairs with the others alone: pairs first, then as many rows as are needed.
    out = -np.sort(-out, axis=0)
    return out[: max(int((out >= 0).sum(axis=0).max(initial=0)), 1)]


def _nearest(
    of: Float[np.ndarray, "many 3"], to: Float[np.ndarray, "points 3"], count: int
) -> Int[np.ndarray, "points count"]:
    """Indices of the nearest points, with the last one repeated if there are too few."""
    k = min(count, len(of))
    found = np.reshape(KDTree(of).query(to, k=k)[1], (len(to), k))
    return np.pad(found, ((0, 0), (0, count - k)), mode="edge")


@pytree
@dataclasses.dataclass(frozen=True)
class _Layers(ClothContact):
    rows: Int[Array, " pairs"]
    start: Int[Array, " pairs"]
    side: Float[Array, "pairs 1 1"]
    ring: Int[Array, "ring vertices"]
    patch: Int[Array, "patch vertices"]
    faces: Int[Array, "faces 3"]
    rim: Float[Array, " vertices"]
    label: Int[Array, " vertices"]
    adjoining: Array
    inverse_mass: Float[Array, "vertices 1 1"]
    pair: Int[Array, "others vertices"]
    has_pair: Float[Array, "others vertices 1 1"]
    law: LayerContact = dataclasses.field(metadata={"static": True})

    def init_state(self, batch: int) -> Int[Array, "pairs batch"]:
        return jnp.repeat(self.start[:, None], batch, axis=1)

    def begin(self, base: Array, start: None, end: None, clock: Clock, state: Array) -> Facing:
        x = jax.lax.stop_gradient(base)
        points = x[self.rows]
        at = state
        for _ in range(self.law.hops):
            at = pick_nearest(points, x, self.ring[:, at])
        corners, weights = closest_of(points, x, self.faces, self.patch[:, at])
        foot = foot_of(x, corners, weights)
        offset = points - foot
        flat = side_normal(x, corners)
        beside = offset - jnp.sum(offset * flat, axis=1, keepdims=True) * flat
        # On edges a triangle's own normal can have the wrong sign; the mean of its
        # neighbours' can't.
        normals = smooth_normals(x, self.faces)
        outwards = foot_of(normals, corners, weights)
        n = self.side * towards(offset, outwards)
        height = jnp.sum(offset * n, axis=1, keepdims=True)
        # Layers that face each other belong to different folds, whose order isn't known: they
        # stay on the side that they are on.
        facing = jnp.sum(outwards * normals[self.rows], axis=1, keepdims=True) < 0
        turn = jnp.where(facing & (height < 0), -1.0, 1.0).astype(base.dtype)
        n, height = turn * n, turn * height
        edge = jnp.sum(weights * (1.0 - self.rim[corners]), axis=0)[:, None] < 1e-3
        past = edge & (jnp.sum(beside * beside, axis=1, keepdims=True) > _BORDER_TOLERANCE**2)
        close = self.adjoining[self.label[self.rows][:, None], self.label[at]][:, None]
        over = close & ~past
        active = over & (height > -_MAX_CORRECTED)
        vertex = jnp.repeat(self.rows[:, None], base.shape[2], axis=1)
        # From positions without `stop_gradient`, so that the height has a derivative.
        height = jnp.sum((base[self.rows] - foot_of(base, corners, weights)) * n, axis=1)[:, None]
        pairs = Pairs(vertex, corners, weights, n, height, active.astype(base.dtype))
        watched = (over & (height > -_MAX_REPORTED)).astype(base.dtype)
        return Facing(pairs, clock, at, watched)

    def project(
        self,
        displacement: Array,
        start: Array,
        context: Facing,
        progress: Array,
        step: Step,
    ) -> Array:
        if not self.rows.size:
            return displacement
        pairs, law = context.pairs, self.law
        n, weights = pairs.normal, pairs.weights
        mine = self.inverse_mass[self.rows]
        theirs = jnp.sum(weights**2 * self.inverse_mass[pairs.corners, 0, 0], axis=0)[:, None]
        share = mine / (mine + theirs + 1e-9)
        relative = displacement[self.rows] - foot_of(displacement, pairs.corners, weights)
        height = pairs.height + jnp.sum(relative * n, axis=1, keepdims=True)
        wanted = wanted_height(pairs.height, law, progress * context.clock.length)
        depth = jnp.maximum(wanted - height, 0.0) * pairs.active
        move = depth * n
        if law.friction:
            before = start[self.rows] - foot_of(start, pairs.corners, weights)
            slide = relative - before
            slide = slide - jnp.sum(slide * n, axis=1, keepdims=True) * n
            length = jnp.sqrt(jnp.sum(slide * slide, axis=1, keepdims=True) + 1e-18)
            move = move - jnp.minimum(1.0, law.friction * depth / length) * slide
        move = share * move
        return displacement + jnp.sum(self.has_pair * materialize(move)[self.pair], axis=0)

    def diagnose(self, displacement: Array, context: Facing) -> dict[str, Array]:
        pairs = context.pairs
        height = pairs.heights(displacement)[:, 0]
        watched = pairs.active if context.watched is None else context.watched
        wrong = (height < 0) & (watched[:, 0] > 0)
        return {
            "layers_crossed": jnp.sum(wrong, axis=0),
            "layers_depth": jnp.max(jnp.where(wrong, -height, 0.0), axis=0, initial=0.0),
        }
