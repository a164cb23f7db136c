"""Contact with the body: closest point on a local patch, Coulomb friction."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.spatial import KDTree

from ...body import NUM_BODY_VERTICES, Body, triangulate
from ...errors import check_counts, check_numbers
from ...geometry import closest_barycentric, fast_argmin, spread_points, vertex_normals
from ...typing import pytree
from .._assembly import Assembly, float32
from .._effect import Clock, Effect, PosedPoints, Prepared, SkinnedPoints, Step
from ._limbs import LOWER_ARMS, TRUNK, UPPER_ARMS, limb_labels
from ._pinch import ROOM, Pinch, prepare_pinch
from ._samples import Samples, sample_faces


@dataclasses.dataclass(frozen=True)
class BodyContact(Effect):
    """Keeps cloth at its thickness from the skin, with Coulomb friction.

    Once per contact interval, each cloth vertex finds its closest skin point. During the
    interval the point and its normal move with the skin and bound a half-space that the
    cloth can't enter at any speed of the limb: nothing tunnels.

    Cloth that lies on the skin *tracks* it: the search starts at the skin point of the
    previous interval and walks over the surface. The cloth may slide any distance but never
    jumps to the far side of a limb, to another limb, or across a fold where the body
    intersects itself. Between two limbs closer than twice its thickness, tracking cloth keeps
    half of the gap. Where the body intersects itself, the cloth of both limbs lies midway, as
    if the flesh were compressed, and its vertices are counted (``pinched``). Loose cloth
    doesn't track but compares a list of patches on all limbs within reach.

    Edges and faces of the cloth larger than ``sample_spacing`` are kept off the skin at sample
    points as well, so that no skin comes through a large triangle.

    Attributes:
        sample_spacing: Largest distance between points of the cloth that feel contact [m].
        patch: Number of triangles around the nearest skin vertex that are compared exactly.
        ring: Number of skin vertices that each step of the walk compares.
        hops: Steps of the walk per contact interval; each covers about two centimetres.
        centres: Number of patches in the list of a loose vertex.
        spacing: Distance between these patches [m].
        push: Largest correction in one substep [m].
        leave: Maximum speed relative to the skin at which touching cloth leaves it [m/s]:
            cloth squeezed into a limb moves out without being ejected. Also the maximum
            speed at which another limb presses cloth onto its own limb.

    References:
        Macklin et al. (2016) for the projection; friction as a clamped tangential
        move, Mueller et al., Position based dynamics (2007), section 3.4.
    """

    sample_spacing: float = 0.03
    patch: int = 12
    ring: int = 16
    hops: int = 3
    centres: int = 96
    spacing: float = 0.026
    push: float = 1.0
    leave: float = 1.0

    def __post_init__(self) -> None:
        check_counts(self, "patch", "ring", "hops", "centres")
        check_numbers(self, "sample_spacing", "spacing", "push")
        check_numbers(self, "leave", zero=True)

    def prepare(self, assembly: Assembly, inverse_mass: Array) -> Prepared:
        """Builds patches around skin vertices and the first skin vertex of each search."""
        samples = sample_faces(assembly.rest, assembly.faces, self.sample_spacing)
        free = np.asarray(inverse_mass) > 0
        assembly = _with_samples(assembly, samples)
        body = assembly.body
        skin = assembly.rest_body[:NUM_BODY_VERTICES]
        faces = np.asarray(triangulate(body.quads))
        weights = np.asarray(body.weights)[:NUM_BODY_VERTICES]
        label = _limbs(weights, body)
        loose = np.flatnonzero(assembly.loose)
        tight = np.flatnonzero(~assembly.loose)
        # Skin out of reach of the cloth is left out and not even posed.
        reach = KDTree(assembly.rest).query(skin, distance_upper_bound=_REACH)[0]
        used = np.flatnonzero(np.isfinite(reach))
        if len(used) < 3 * self.patch:
            used = np.arange(len(skin))
        start = _starting_vertices(assembly, skin, used, label, tight)
        listed = _patch_centres(assembly, skin, used, loose, self.spacing, self.centres)
        kept = np.flatnonzero(np.isin(faces, used).all(axis=1))
        size = min(self.patch, len(kept))
        far, near = KDTree(skin[faces[kept]].mean(axis=1)).query(skin[used], k=size)
        far, near = far.reshape(len(used), size), near.reshape(len(used), size)
        ring = KDTree(skin[used]).query(skin[used], k=min(self.ring, len(used)))[1]
        local = np.zeros(len(skin), dtype=np.int32)
        local[used] = np.arange(len(used))
        normals = vertex_normals(float32(skin), jnp.asarray(faces))
        skinned_points = SkinnedPoints(
            float32(skin[used]), normals[jnp.asarray(used)], body.weights[jnp.asarray(used)]
        )
        return _Contact(
            samples,
            skinned_points,
            jnp.asarray(ring.reshape(len(used), -1).T.astype(np.int32)),
            jnp.asarray(near.T.astype(np.int32)),
            jnp.asarray(np.moveaxis(local[faces[kept]][near], 0, 2)),
            float32(far[:, -1]),
            jnp.asarray(local[faces[kept]]),
            jnp.asarray(tight.astype(np.int32)),
            jnp.asarray(loose.astype(np.int32)),
            jnp.asarray(np.argsort(np.concatenate([tight, loose])).astype(np.int32)),
            jnp.asarray(local[start]),
            jnp.asarray(local[listed].T),
            float32(assembly.thickness[:, None]),
            float32(assembly.friction[:, None]),
            float32(free[:, None]),
            prepare_pinch(skin[used], np.asarray(skinned_points.normals), weights[used], body),
            jnp.asarray(assembly.loose[:, None]),
            self.push,
            self.leave,
            self.hops,
        )


# Gap that counts as unlimited [m].
_FREE = 10.0
# Offset above the middle of a pinch, so that skin beside it stays covered [m].
_COVER = 0.002
# Cloth closer than this to its minimum height touches the skin [m].
_NEAR = 0.001
# Skin farther than this from all cloth at rest is left out [m].
_REACH = 0.30


def _with_samples(assembly: Assembly, samples: Samples) -> Assembly:
    """The vertices with the samples after them, for everything that contact needs of them."""
    corners, weights = np.asarray(samples.corners), np.asarray(samples.weights)

    def more(x: np.ndarray) -> np.ndarray:
        there = np.einsum("ks,ks...->s...", weights, x[corners])
        return np.concatenate([x, there.astype(x.dtype)])

    def some(x: np.ndarray) -> np.ndarray:
        return np.concatenate([x, x[corners].any(axis=0)])

    return dataclasses.replace(
        assembly,
        rest=more(assembly.rest),
        mass=more(assembly.mass),
        pinned=some(assembly.pinned),
        weights=more(assembly.weights),
        thickness=more(assembly.thickness),
        friction=more(assembly.friction),
        loose=some(assembly.loose),
    )


def _starting_vertices(
    assembly: Assembly,
    skin: Float[np.ndarray, "body 3"],
    used: Int[np.ndarray, " used"],
    label: Int[np.ndarray, " body"],
    rows: Int[np.ndarray, " tight"],
) -> Int[np.ndarray, " tight"]:
    """The nearest skin vertex of the same limb for each cloth vertex at rest."""
    cloth = _limbs(assembly.weights, assembly.body)[rows]
    out = np.zeros(len(rows), dtype=np.int64)
    for lab in np.unique(cloth):
        selected = cloth == lab
        # Cloth of a limb starts on that limb or the trunk, cloth of the trunk anywhere.
        pool = used if lab == TRUNK else used[(label[used] == lab) | (label[used] == TRUNK)]
        pool = pool if len(pool) else used
        out[selected] = pool[KDTree(skin[pool]).query(assembly.rest[rows[selected]])[1]]
    return out


def _patch_centres(
    assembly: Assembly,
    skin: Float[np.ndarray, "body 3"],
    used: Int[np.ndarray, " used"],
    rows: Int[np.ndarray, " loose"],
    spacing: float,
    count: int,
) -> Int[np.ndarray, "loose k"]:
    """Skin vertices whose patches each loose vertex compares."""
    pool = used[spread_points(skin[used], spacing)]
    k = min(count, len(pool))
    return pool[KDTree(skin[pool]).query(assembly.rest[rows], k=k)[1].reshape(len(rows), k)]


def _limbs(weights: Float[np.ndarray, "points joints"], body: Body) -> Int[np.ndarray, " points"]:
    """Limb labels, between which tight garments don't slide; each arm is one limb."""
    label = limb_labels(weights, body)
    for upper, lower in zip(UPPER_ARMS, LOWER_ARMS, strict=True):
        label[label == lower] = upper
    return label


@pytree
@dataclasses.dataclass(frozen=True)
class _Surface:
    """The skin beside each vertex and sample during a contact interval.

    Attributes:
        where: Vector from the cloth to its skin point at the start [m].
        way: Motion of the skin point during the interval [m].
        normal: Skin normal at the start, not normalised.
        turn: Change of the normal during the interval.
        height: Minimum height above the skin at the start [m].
        rise: Change of the minimum height during the interval [m].
        top: Maximum height above the skin at the start, due to another limb [m].
        fall: Change of the maximum height during the interval [m].
    """

    where: Float[Array, "points 3 batch"]
    way: Float[Array, "points 3 batch"]
    normal: Float[Array, "points 3 batch"]
    turn: Float[Array, "points 3 batch"]
    height: Float[Array, "points 1 batch"]
    rise: Float[Array, "points 1 batch"]
    top: Float[Array, "points 1 batch"]
    fall: Float[Array, "points 1 batch"]

    def height_of(self, displacement: Array, progress: Array) -> tuple[Array, Array]:
        """Unit normals, and heights above the skin [m]."""
        n = self.normal + progress * self.turn
        n = n / jnp.sqrt(jnp.sum(n * n, axis=1, keepdims=True) + 1e-12)
        gap = displacement - (self.where + progress * self.way)
        return n, jnp.sum(gap * n, axis=1, keepdims=True)


@pytree
@dataclasses.dataclass(frozen=True)
class _Touch:
    """Contacts of all cloth vertices and samples with the skin in a contact interval.

    Attributes:
        surface: The skin beside them.
        centre: Skin vertices at which the next search starts.
        room: Gap at each skin vertex at the end, see `Pinch.room`.
        missed: Whether the closest point may lie beyond the patch.
        unit: Unit normal at the start.
        ceiling: Maximum outward speed of touching cloth [m/s].
    """

    surface: _Surface
    centre: Int[Array, "tight batch"]
    room: Float[Array, "skin batch"]
    missed: Bool[Array, "points batch"]
    unit: Float[Array, "points 3 batch"]
    ceiling: Float[Array, "points 1 batch"]


@pytree
@dataclasses.dataclass(frozen=True)
class _Contact(Prepared):
    unilateral = True
    samples: Samples
    skin: SkinnedPoints
    ring: Int[Array, "ring skin"]
    table: Int[Array, "patch skin"]
    corners: Int[Array, "patch 3 skin"]
    radius: Float[Array, " skin"]
    faces: Int[Array, "faces 3"]
    tight: Int[Array, " tight"]
    loose: Int[Array, " loose"]
    order: Int[Array, " vertices"]
    start: Int[Array, " tight"]
    listed: Int[Array, "k loose"]
    thickness: Float[Array, "vertices 1"]
    friction: Float[Array, "vertices 1"]
    free: Float[Array, "vertices 1"]
    pinch: Pinch
    hanging: Bool[Array, "vertices 1"]
    push: float = dataclasses.field(metadata={"static": True})
    leave: float = dataclasses.field(metadata={"static": True})
    hops: int = dataclasses.field(metadata={"static": True})

    @property
    def skinned_points(self) -> SkinnedPoints:
        return self.skin

    materials = ("friction",)

    def rescaled(self, factors: Mapping[str, Any]) -> Prepared:
        if "friction" not in factors:
            return self
        return dataclasses.replace(self, friction=self.friction * factors["friction"])

    def init_state(self, batch: int) -> tuple[Array, Array]:
        room = jnp.full((self.skin.rest.shape[0], batch), ROOM, self.skin.rest.dtype)
        return jnp.repeat(self.start[:, None], batch, axis=1), room

    def update_state(self, context: _Touch) -> tuple[Array, Array]:
        return context.centre, context.room

    def walk(
        self,
        points: Float[Array, "some 3 batch"],
        skin: Float[Array, "skin 3 batch"],
        at: Int[Array, "some batch"],
    ) -> Int[Array, "some batch"]:
        """Moves ``hops`` times to the nearest skin vertex of the current vertex's ring."""

        def hop(_: Array, at: Array) -> Array:
            return _pick(points, skin, self.ring[:, at])

        return jax.lax.fori_loop(0, self.hops, hop, at)

    def closest(
        self,
        points: Float[Array, "some 3 batch"],
        skin: Float[Array, "skin 3 batch"],
        centre: Int[Array, "some batch"],
    ) -> tuple[Array, Array]:
        """Face and barycentric weights [3, some, batch] of the closest point on a patch."""
        batch = points.shape[2]
        # [patch, 3, some, batch], flattened so that each gather reads scalars.
        corner = (
            self.corners[:, :, centre] * batch
            + jnp.arange(batch, dtype=jnp.int32)[None, None, None]
        )
        flat = [skin[:, i].reshape(-1) for i in range(3)]
        tri = [jnp.stack([f[corner[:, k]] for f in flat]) for k in range(3)]
        p = jnp.broadcast_to(jnp.moveaxis(points, 1, 0)[:, None], tri[0].shape)
        weights, squared = closest_barycentric(p, *tri)
        best = jnp.argmin(squared, axis=0)
        face = jnp.take_along_axis(self.table[:, centre], best[None], axis=0)[0]
        weights = jnp.take_along_axis(weights, best[None, None], axis=1)[:, 0]
        return jax.lax.stop_gradient(face), weights

    def begin(
        self,
        base: Array,
        start: PosedPoints,
        end: PosedPoints,
        clock: Clock,
        state: tuple[Array, Array],
    ) -> _Touch:
        base = self.samples.extend(base)
        stop = jax.lax.stop_gradient
        points = stop(start.points)
        centre, room = state
        centre = self.walk(stop(base[self.tight]), points, centre)
        last = centre
        if self.loose.shape[0]:
            loose = stop(base[self.loose])
            listed = self.listed[..., None]
            listed = jnp.broadcast_to(listed, (*self.listed.shape, loose.shape[2]))
            there = self.walk(loose, points, _pick(loose, points, listed))
            last = jnp.concatenate([centre, there])[self.order]
        face, weights = self.closest(base, start.points, last)
        p0, n0 = _surface(start, self.faces, face, weights)
        p1, n1 = _surface(end, self.faces, face, weights)
        lane = jnp.arange(base.shape[2])[None]
        from_centre = p0 - jnp.moveaxis(start.points[last, :, lane], -1, 1)
        far = jnp.sum(from_centre**2, axis=1) > self.radius[last] ** 2
        unit = n0 / jnp.sqrt(jnp.sum(n0 * n0, axis=1, keepdims=True) + 1e-12)
        later = self.pinch.room(end)
        wanted, top = self._height_bounds(room, face, weights)
        rise, fall = self._height_bounds(later, face, weights)
        height = jnp.sum((base - p0) * unit, axis=1, keepdims=True)
        touching = height < wanted + _NEAR
        fastest = jnp.sum((p1 - p0) * unit, axis=1, keepdims=True) / clock.length + self.leave
        ceiling = jnp.where(touching, fastest, jnp.inf)
        heights = wanted, rise - wanted, top, fall - top
        surface = _Surface(p0 - base, p1 - p0, n0, n1 - n0, *heights)
        return _Touch(surface, centre, later, far, unit, ceiling)

    def _height_bounds(self, room: Array, face: Array, weights: Array) -> tuple[Array, Array]:
        """Minimum and maximum height above the skin [m], equal where limbs leave no gap."""
        lane = jnp.arange(room.shape[1])[None]
        tri = self.faces[face]
        there = jnp.sum(
            jnp.stack([weights[k] * room[tri[..., k], lane] for k in range(3)]), axis=0
        )[:, None]
        # Grows smoothly to `_FREE` as the gap approaches `ROOM`, beyond which there is no pinch.
        there = there / jnp.maximum(1.0 - (jnp.maximum(there, 0.0) / ROOM) ** 2, ROOM / _FREE)
        there = jnp.where(self.hanging[..., None], _FREE, there)
        thickness = self.thickness[..., None]
        # Layers keep their order on both limbs: the outermost lies in the middle.
        outermost = self.thickness.max()
        under = outermost - thickness
        low = jnp.minimum(thickness, 0.5 * there + _COVER - under)
        return low, jnp.maximum(there - outermost - under, low)

    def accelerate(self, velocity: Array, context: _Touch, h: float) -> Array:
        unit, ceiling = context.unit[: len(velocity)], context.ceiling[: len(velocity)]
        outwards = jnp.sum(velocity * unit, axis=1, keepdims=True)
        return velocity - jnp.maximum(outwards - ceiling, 0.0) * unit

    def project(
        self,
        displacement: Array,
        start: Array,
        context: _Touch,
        progress: Array,
        step: Step,
    ) -> Array:
        vertices = len(displacement)
        own = jax.tree.map(lambda x: x[:vertices], context.surface)
        moved, _ = self._pushed(displacement, start, own, progress, step, slice(vertices))
        moved = displacement + (moved - displacement) * self.free[..., None]
        if self.samples.count:
            rest = jax.tree.map(lambda x: x[vertices:], context.surface)
            at = self.samples.points(moved)
            pushed, lift = self._pushed(
                at, self.samples.points(start), rest, progress, step, slice(vertices, None)
            )
            moved = self.samples.push(moved, pushed - at, lift != 0, self.free)
        return moved

    def _pushed(
        self,
        displacement: Array,
        start: Array,
        context: "_Surface",
        progress: Array,
        step: Step,
        points: slice,
    ) -> tuple[Array, Array]:
        """Displacements of points after contact and friction, and how far they were lifted [m]."""
        n, height = context.height_of(displacement, progress)
        low = context.height + progress * context.rise
        high = context.top + progress * context.fall
        slowest = -self.leave * step.length
        lift = jnp.clip(jnp.clip(height, low, high) - height, slowest, self.push)
        # Without a maximum height, cloth above the skin is free.
        lift = jnp.where(high > 0.9 * _FREE, jnp.maximum(lift, 0.0), lift)
        moved = displacement + lift * n
        # Friction opposes the motion relative to the skin in this substep.
        slide = (moved - start) - step.share * context.way
        slide = slide - jnp.sum(slide * n, axis=1, keepdims=True) * n
        length = jnp.sqrt(jnp.sum(slide * slide, axis=1, keepdims=True) + 1e-18)
        hold = jnp.minimum(1.0, self.friction[points][..., None] * jnp.abs(lift) / length)
        return moved - hold * slide, lift

    def diagnose(self, displacement: Array, context: _Touch) -> dict[str, Array]:
        points = self.samples.extend(displacement)
        height = context.surface.height_of(points, jnp.ones((), displacement.dtype))[1]
        # Depth below the skin or, in a pinch, below a thickness under its middle.
        wanted = context.surface.height + context.surface.rise
        inside = (wanted - self.thickness[..., None] - height)[:, 0]
        return {
            "penetration_max": jnp.maximum(inside.max(axis=0), 0.0),
            "inside_share": jnp.mean((inside > 0).astype(displacement.dtype), axis=0),
            # Far from the skin the choice of the closest point doesn't matter.
            "missed": jnp.sum(context.missed & (inside > -0.02), axis=0),
            "pinched": jnp.sum(wanted[:, 0] < 0, axis=0),
        }


def _pick(
    points: Float[Array, "some 3 batch"],
    skin: Float[Array, "skin 3 batch"],
    candidates: Int[Array, "candidates some batch"],
) -> Int[Array, "some batch"]:
    """The nearest of each point's candidates among the skin vertices."""
    batch = points.shape[2]
    flat = candidates * batch + jnp.arange(batch, dtype=jnp.int32)[None, None]
    gaps = [skin[:, i].reshape(-1)[flat] - points[None, :, i] for i in range(3)]
    gap = gaps[0] ** 2 + gaps[1] ** 2 + gaps[2] ** 2
    best = fast_argmin(gap.reshape(len(gap), -1), axis=0).reshape(1, *gap.shape[1:])
    return jnp.take_along_axis(candidates, best, axis=0)[0]


def _surface(skin: PosedPoints, faces: Array, face: Array, weights: Array) -> tuple[Array, Array]:
    """Points and smooth normals of the skin, shape [vertices, 3, batch]."""
    lane = jnp.arange(skin.points.shape[2])[None]
    tri = faces[face]
    point = normal = jnp.zeros((), skin.points.dtype)
    for k in range(3):
        w = weights[k][:, None]
        point = point + w * jnp.moveaxis(skin.points[tri[..., k], :, lane], -1, 1)
        normal = normal + w * jnp.moveaxis(skin.normals[tri[..., k], :, lane], -1, 1)
    return point, normal
