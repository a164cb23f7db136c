"""Contact of a garment with itself."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ...errors import check_counts, check_numbers
from ...geometry import connected_components, mesh_edges, vertex_faces
from ...typing import pytree
from .._assembly import Assembly
from .._effect import Clock, Effect, Prepared
from ._pairs import ClothContact, Facing, Pairs, closest_of, foot_of, side_normal, smooth_normals


@dataclasses.dataclass(frozen=True)
class SelfContact(Effect):
    """Keeps a garment's folds apart, on the sides they have at the start of an interval.

    Every few contact intervals, a grid search finds for each vertex the nearest vertex in
    front of the cloth and the nearest one behind it. Neighbours (vertices of one piece that
    are close at rest and face the same way) are excluded. In each interval, the closest
    triangle around each vertex found makes a pair, which keeps the gap along its direction
    at the start. Edges that cross aren't detected: folds sharper than a triangle may
    intersect each other.

    Attributes:
        gap: Distance kept [m].
        friction: Coulomb coefficient of cloth on itself [1].
        leave: Speed at which folds that are too close separate [m/s].
        reach: Pairs closer than this are active [m]. The median rest length of edges plus
            the gap if None; folds with edges twice as long aren't fully covered.
        every: Contact intervals between two grid searches.
        room: Capacity of a grid cell in vertices; more set `Status.OVERFLOW`.

    References:
        Bridson, Fedkiw and Anderson, Robust treatment of collisions, contact and
        friction for cloth animation (2002); Teschner et al., Optimized spatial hashing
        for collision detection of deformable objects (2003).
    """

    gap: float = 0.002
    friction: float = 0.3
    leave: float = 0.2
    reach: float | None = None
    every: int = 4
    room: int = 24

    def __post_init__(self) -> None:
        check_numbers(self, "gap", "reach")
        check_numbers(self, "friction", "leave", zero=True)
        check_counts(self, "every", "room")

    def prepare(self, assembly: Assembly, inverse_mass: Array) -> Prepared:
        """Builds tables of triangles and neighbours."""
        x, f = assembly.rest, assembly.faces
        ends = mesh_edges(f).vertices
        length = np.linalg.norm(x[ends[:, 0]] - x[ends[:, 1]], axis=1)
        usual, most = np.quantile(length, [0.5, 0.95]) if len(length) else (0.0, 0.0)
        reach = usual + self.gap if self.reach is None else self.reach
        part = np.searchsorted(np.asarray(assembly.parts), np.arange(len(x)), side="right")
        n = np.zeros_like(x)
        for k in range(3):
            np.add.at(n, f[:, k], np.cross(x[f[:, 1]] - x[f[:, 0]], x[f[:, 2]] - x[f[:, 0]]))
        return _SelfContact(
            jax.device_put(x.astype(np.float32)),
            jax.device_put(n.astype(np.float32)),
            jax.device_put(connected_components(f, len(x))),
            jax.device_put(part.astype(np.int32)),
            jax.device_put(vertex_faces(f, len(x)).T.astype(np.int32)),
            jax.device_put(f.astype(np.int32)),
            jax.device_put(inverse_mass)[:, None, None],
            self,
            float(reach),
            float(2.5 * max(most, self.gap)),
        )


@pytree
@dataclasses.dataclass(frozen=True)
class _SelfContact(ClothContact):
    rest: Float[Array, "vertices 3"]
    facing: Float[Array, "vertices 3"]
    piece: Int[Array, " vertices"]
    part: Int[Array, " vertices"]
    around: Int[Array, "degree vertices"]
    faces: Int[Array, "faces 3"]
    inverse_mass: Float[Array, "vertices 1 1"]
    law: SelfContact = dataclasses.field(metadata={"static": True})
    reach: float = dataclasses.field(metadata={"static": True})
    apart: float = dataclasses.field(metadata={"static": True})

    def init_state(self, batch: int) -> tuple[Array, Array, Array]:
        count = self.rest.shape[0]
        none = jnp.full((2, count, batch), -1, jnp.int32)
        return jnp.zeros((), jnp.int32), none, jnp.zeros(batch, jnp.int32)

    def begin(self, base: Array, start: None, end: None, clock: Clock, state: tuple) -> Facing:
        x = jax.lax.stop_gradient(base)
        batch = base.shape[2]
        search = jax.vmap(self.nearest, in_axes=2, out_axes=(2, 0))
        near, crowd = jax.lax.cond(state[0] == 0, lambda: search(x), lambda: (state[1], state[2]))
        new_state = (state[0] + 1) % self.law.every, near, crowd
        # [2 vertices, batch]: in front of the cloth, then behind it.
        near = near.reshape(-1, batch)
        own = jnp.arange(base.shape[0], dtype=near.dtype)
        vertex = jnp.repeat(jnp.concatenate([own, own])[:, None], batch, axis=1)
        found = (near >= 0)[:, None]
        around = self.around[:, jnp.maximum(near, 0)]
        corners, weights = closest_of(jnp.concatenate([x, x]), x, self.faces, around)
        offset = jnp.concatenate([x, x]) - foot_of(x, corners, weights)
        length = jnp.sqrt(jnp.sum(offset * offset, axis=1, keepdims=True) + 1e-18)
        # Coincident points have no direction: use the triangle's normal.
        n = jnp.where(length > 1e-6, offset / length, side_normal(x, corners))
        positions = jnp.concatenate([base, base])
        height = jnp.sum((positions - foot_of(base, corners, weights)) * n, axis=1, keepdims=True)
        active = (found & (length < self.reach)).astype(base.dtype)
        return Facing(Pairs(vertex, corners, weights, n, height, active), clock, new_state)

    def nearest(self, x: Float[Array, "vertices 3"]) -> tuple[Int[Array, "2 vertices"], Array]:
        """The nearest vertex on each side of the cloth, -1 for none, and the overflow."""
        law, count = self.law, x.shape[0]
        # A sphere of radius `reach` touches at most the eight cells around a corner.
        cell = 2.0 * self.reach
        size = 1 << int(np.ceil(np.log2(2 * count + 1)))
        safe = jnp.where(jnp.isfinite(x), x, 0.0) / cell

        def key(place: Int[Array, "... 3"]) -> Int[Array, "..."]:
            a, b, c = (place[..., i] for i in range(3))
            mixed = (a * 73856093) ^ (b * 19349663) ^ (c * 83492791)
            return mixed & (size - 1)

        home = jnp.floor(safe).astype(jnp.int32)
        slot = key(home)
        order = jnp.argsort(slot)
        counts = jnp.zeros(size, jnp.int32).at[slot].add(1)
        cell_starts = jnp.cumsum(counts) - counts
        # The half of its cell in which a vertex lies determines the cells to search.
        first = jnp.floor(safe - 0.5).astype(jnp.int32)
        corner = jnp.asarray([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)], jnp.int32)
        cells = key(first[:, None] + corner[None])
        lane = jnp.arange(law.room, dtype=jnp.int32)[None, None]
        place = cell_starts[cells][..., None] + lane
        other = order[jnp.minimum(place, count - 1)].astype(jnp.int32)
        valid = lane < counts[cells][..., None]
        other, valid = other.reshape(count, -1), valid.reshape(count, -1)
        gap = x[other] - x[:, None]
        squared = jnp.sum(gap * gap, axis=2)
        rest = self.rest[other] - self.rest[:, None]
        facing = jnp.sum(self.facing[other] * self.facing[:, None], axis=2) > 0
        beside = facing & (self.piece[other] == self.piece[:, None])
        valid &= ~beside | (jnp.sum(rest * rest, axis=2) > self.apart**2)
        valid &= other != jnp.arange(count, dtype=jnp.int32)[:, None]
        valid &= self.part[other] == self.part[:, None]
        valid &= squared < (2.0 * cell) ** 2
        normal = smooth_normals(x[..., None], self.faces)[..., 0]
        front = jnp.sum(gap * normal[:, None], axis=2) >= 0
        out = []
        for side in (front, ~front):
            measure = jnp.where(valid & side, squared, jnp.inf)
            best = jnp.argmin(measure, axis=1)[:, None]
            there = jnp.isfinite(jnp.take_along_axis(measure, best, axis=1))[:, 0]
            out.append(jnp.where(there, jnp.take_along_axis(other, best, axis=1)[:, 0], -1))
        return jnp.stack(out), jnp.sum(jnp.maximum(counts - law.room, 0), dtype=jnp.int32)

    def diagnose(self, displacement: Array, context: Facing) -> dict[str, Array]:
        pairs = context.pairs
        height = pairs.heights(displacement)
        gap = jnp.where(pairs.active > 0, height, jnp.inf)
        return {"self_gap": gap.min(axis=(0, 1)), "overflow": context.state[2]}
