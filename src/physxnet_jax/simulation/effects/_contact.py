"""Contact with the body: closest point on a local patch, Coulomb friction."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.spatial import KDTree

from ...body import NUM_BODY_VERTICES, triangulate
from ...errors import check_counts, check_numbers
from ...geometry import (
    closest_barycentric,
    materialize,
    mesh_edges,
    vertex_normals,
)
from ...typing import pytree
from .._assembly import Assembly, float32
from .._effect import Clock, Effect, PosedPoints, Prepared, Rest, SkinnedPoints, Step
from ._gather import gather_corners, nearest_face, pick_nearest
from ._pinch import ROOM, Pinch, prepare_pinch
from ._relief import relief
from ._samples import Samples, sample_faces, with_samples
from ._search_start import patch_centres, sleeve_labels, starting_vertices


@dataclasses.dataclass(frozen=True)
class BodyContact(Effect):
    """Keeps cloth at least its thickness from the skin, with Coulomb friction.

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
    points as well, so that no skin comes through a large triangle. Over features of the skin
    smaller than a triangle the corners lie at least as high as they are.

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

    sample_spacing: float = 0.035
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
        reaches = [_RELIEF_REACH * min(n, self.sample_spacing) for n in _edge_lengths(assembly)]
        faces = np.concatenate([assembly.faces, assembly.coarse_faces])
        samples = sample_faces(assembly.rest, faces, self.sample_spacing)
        free = np.asarray(inverse_mass) > 0
        part = np.searchsorted(assembly.parts, np.arange(len(assembly.rest)), side="right") - 1
        part = np.concatenate([part, part[np.asarray(samples.corners[0])]])
        assembly = with_samples(assembly, samples)
        body = assembly.body
        skin = assembly.rest_body[:NUM_BODY_VERTICES]
        faces = np.asarray(triangulate(body.quads))
        weights = np.asarray(body.weights)[:NUM_BODY_VERTICES]
        label = sleeve_labels(weights, body)
        loose = np.flatnonzero(assembly.loose)
        tight = np.flatnonzero(~assembly.loose)
        # Skin out of reach of the cloth is left out and not even posed.
        distance = KDTree(assembly.rest).query(skin, distance_upper_bound=_REACH)[0]
        used = np.flatnonzero(np.isfinite(distance))
        if len(used) < 3 * self.patch:
            used = np.arange(len(skin))
        start = starting_vertices(assembly, skin, used, label, tight)
        listed = patch_centres(assembly, skin, used, loose, self.spacing, self.centres)
        kept = np.flatnonzero(np.isin(faces, used).all(axis=1))
        size = min(self.patch, len(kept))
        far, near = KDTree(skin[faces[kept]].mean(axis=1)).query(skin[used], k=size)
        far, near = far.reshape(len(used), size), near.reshape(len(used), size)
        ring = KDTree(skin[used]).query(skin[used], k=min(self.ring, len(used)))[1]
        local = np.zeros(len(skin), dtype=np.int32)
        local[used] = np.arange(len(used))
        normals = vertex_normals(skin, faces)
        skinned_points = SkinnedPoints(
            float32(skin[used]), float32(normals[used]), body.weights[jax.device_put(used)]
        )
        return _Contact(
            samples,
            skinned_points,
            float32(np.stack([relief(skin, normals, r)[used] for r in reaches], 1)),
            jax.device_put(part.astype(np.int32)),
            jax.device_put(ring.reshape(len(used), -1).T.astype(np.int32)),
            jax.device_put(near.T.astype(np.int32)),
            float32(far[:, -1]),
            jax.device_put(local[faces[kept]]),
            jax.device_put(tight.astype(np.int32)),
            jax.device_put(loose.astype(np.int32)),
            jax.device_put(np.argsort(np.concatenate([tight, loose])).astype(np.int32)),
            jax.device_put(local[start]),
            jax.device_put(local[listed].T),
            float32(assembly.thickness[:, None]),
            float32(assembly.friction[:, None]),
            float32(free[:, None]),
            jax.device_put(used.astype(np.int32)),
            prepare_pinch(skin[used], np.asarray(skinned_points.normals), weights[used], body),
            jax.device_put(assembly.loose[:, None]),
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
# Cloth farther below the skin than this goes back to the side on which it was [m].
_DEEP = 0.012
# Gap kept to the highest skin below a triangle [m].
_CLEARANCE = 0.002
# Distance from a triangle's middle to its corners, over the length of its edges.
_RELIEF_REACH = 0.6


def _edge_lengths(assembly: Assembly) -> list[float]:
    """Length of long edges of each garment, or of the mesh that it refines, at rest [m]."""
    out = []
    for i, j in zip(assembly.parts, assembly.parts[1:]):
        own, coarse = (
            f[((f >= i) & (f < j)).all(axis=1)] for f in (assembly.faces, assembly.coarse_faces)
        )
        ends = mesh_edges(coarse if len(coarse) else own).vertices
        length = np.linalg.norm(assembly.rest[ends[:, 0]] - assembly.rest[ends[:, 1]], axis=1)
        out.append(float(np.quantile(length, 0.9)) if len(length) else 0.0)
    return out


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
        surface: The skin beside the vertices.
        beside: The skin beside the samples.
        centre: Skin vertices at which the next search starts.
        room: Gap at each skin vertex at the end, see `Pinch.room`.
        margin: Gap kept to the skin where nothing else is in the way [m].
        missed: Whether the closest point may lie beyond the patch.
        unit: Unit normal at the start.
        ceiling: Maximum outward speed of touching cloth [m/s].
    """

    surface: _Surface
    beside: _Surface
    centre: Int[Array, "tight batch"]
    room: Float[Array, "skin batch"]
    margin: Float[Array, "points 1 batch"]
    missed: Bool[Array, "points batch"]
    unit: Float[Array, "points 3 batch"]
    ceiling: Float[Array, "points 1 batch"]


@pytree
@dataclasses.dataclass(frozen=True)
class _Contact(Prepared):
    unilateral = True
    samples: Samples
    skin: SkinnedPoints
    relief: Float[Array, "skin garments"]
    part: Int[Array, " points"]
    ring: Int[Array, "ring skin"]
    table: Int[Array, "patch skin"]
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
    used: Int[Array, " skin"]
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

    def reshaped(self, rest: Rest) -> Prepared:
        """The skin moves; which parts of it are compared, and its relief, stay."""
        skin = dataclasses.replace(
            self.skin,
            rest=rest.body[self.used],
            normals=rest.normals[self.used],
        )
        return dataclasses.replace(self, skin=skin)

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
        """Moves up to ``hops`` times to the nearest skin vertex of the current vertex's ring."""

        def hop(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
            at, _, count = carry
            to = pick_nearest(points, skin, self.ring[:, at])
            return to, jnp.any(to != at), count + 1

        def goes_on(carry: tuple[Array, Array, Array]) -> Array:
            return carry[1] & (carry[2] < self.hops)

        start = at, jnp.ones((), bool), jnp.zeros((), jnp.int32)
        return jax.lax.while_loop(goes_on, hop, start)[0]

    def raised(
        self,
        points: Float[Array, "some 3 batch"],
        posed: PosedPoints,
        at: Int[Array, "some batch"],
    ) -> Float[Array, "some 3 batch"]:
        """Points, raised above the skin that they were at if they are deep in the body.

        The skin nearest to a point in a limb may be that of the limb's other side.
        """
        lane = jnp.arange(points.shape[2])[None]
        there, normal = (
            jnp.moveaxis(jax.lax.stop_gradient(v)[at, :, lane], -1, 1)
            for v in (posed.points, posed.normals)
        )
        height = jnp.sum((points - there) * normal, axis=1, keepdims=True)
        return jnp.where(height < -_DEEP, points - height * normal, points)

    def closest(
        self,
        points: Float[Array, "some 3 batch"],
        skin: Float[Array, "skin 3 batch"],
        centre: Int[Array, "some batch"],
    ) -> tuple[Array, Array]:
        """Face and barycentric weights [3, some, batch] of the closest point on a patch."""
        stop = jax.lax.stop_gradient
        face = nearest_face(stop(points), stop(skin), self.faces, self.table[:, centre])
        corners = gather_corners(skin, self.faces[face], axis=-1)
        weights, _ = closest_barycentric(jnp.moveaxis(points, 1, 0), *corners)
        return face, weights

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
        seen = self.raised(base[self.tight], start, centre)
        centre = self.walk(stop(seen), points, centre)
        last = centre
        if self.loose.shape[0]:
            loose = stop(base[self.loose])
            listed = self.listed[..., None]
            listed = jnp.broadcast_to(listed, (*self.listed.shape, loose.shape[2]))
            there = self.walk(loose, points, pick_nearest(loose, points, listed))
            last = jnp.concatenate([centre, there])[self.order]
            seen = jnp.concatenate([seen, base[self.loose]])[self.order]
        face, weights = self.closest(seen, start.points, last)
        p0, n0 = _surface(start, self.faces, face, weights)
        p1, n1 = _surface(end, self.faces, face, weights)
        lane = jnp.arange(base.shape[2])[None]
        from_centre = p0 - jnp.moveaxis(start.points[last, :, lane], -1, 1)
        far = jnp.sum(from_centre**2, axis=1) > self.radius[last] ** 2
        unit = n0 / jnp.sqrt(jnp.sum(n0 * n0, axis=1, keepdims=True) + 1e-12)
        later = self.pinch.room(end)
        over = self._at(self.relief, face, weights, self.part[:, None]) + _CLEARANCE
        margin = jnp.maximum(self.thickness[..., None], over)
        wanted, top = self._height_bounds(self._at(room, face, weights), margin)
        rise, fall = self._height_bounds(self._at(later, face, weights), margin)
        height = jnp.sum((base - p0) * unit, axis=1, keepdims=True)
        touching = height < wanted + _NEAR
        fastest = jnp.sum((p1 - p0) * unit, axis=1, keepdims=True) / clock.length + self.leave
        ceiling = jnp.where(touching, fastest, jnp.inf)
        heights = wanted, rise - wanted, top, fall - top
        surface = _Surface(p0 - base, p1 - p0, n0, n1 - n0, *heights)
        vertices = len(base) - self.samples.count
        # In two parts, because samples are pushed after the vertices.
        own, beside = (
            materialize(jax.tree.map(lambda x, rows=rows: x[rows], surface))
            for rows in (slice(vertices), slice(vertices, None))
        )
        return _Touch(own, beside, centre, later, margin, far, unit, ceiling)

    def _at(
        self, values: Array, face: Array, weights: Array, lane: Array | None = None
    ) -> Float[Array, "points 1 batch"]:
        """Values of skin vertices at points of faces; of the columns ``lane``, or the batch's."""
        lane = jnp.arange(values.shape[1])[None] if lane is None else lane
        tri = self.faces[face]
        parts = [weights[k] * values[tri[..., k], lane] for k in range(3)]
        return jnp.sum(jnp.stack(parts), axis=0)[:, None]

    def _height_bounds(self, room: Array, margin: Array) -> tuple[Array, Array]:
        """Minimum and maximum height above the skin [m], equal where limbs leave no gap."""
        # Grows smoothly to `_FREE` as the gap approaches `ROOM`, beyond which there is no pinch.
        there = room / jnp.maximum(1.0 - (jnp.maximum(room, 0.0) / ROOM) ** 2, ROOM / _FREE)
        there = jnp.where(self.hanging[..., None], _FREE, there)
        # Layers keep their order on both limbs: the outermost lies in the middle.
        outermost = self.thickness.max()
        under = outermost - self.thickness[..., None]
        low = jnp.minimum(margin, 0.5 * there + _COVER - under)
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
        vertices = slice(len(displacement))
        moved, _ = self._pushed(displacement, start, context.surface, progress, step, vertices)
        moved = displacement + (moved - displacement) * self.free[..., None]
        if self.samples.count:
            moved = materialize(moved)
            at, before = materialize((self.samples.points(moved), self.samples.points(start)))
            rest = slice(len(displacement), None)
            pushed, lift = self._pushed(at, before, context.beside, progress, step, rest)
            move, acts = materialize((pushed - at, (lift != 0).astype(at.dtype)))
            moved = self.samples.push(moved, move, acts, self.free)
        return moved

    def _pushed(
        self,
        displacement: Array,
        start: Array,
        surface: _Surface,
        progress: Array,
        step: Step,
        points: slice,
    ) -> tuple[Array, Array]:
        """Displacements of points after contact and friction, and how far they were lifted [m]."""
        n, height = surface.height_of(displacement, progress)
        low = surface.height + progress * surface.rise
        high = surface.top + progress * surface.fall
        slowest = -self.leave * step.length
        lift = jnp.clip(jnp.clip(height, low, high) - height, slowest, self.push)
        # Without a maximum height, cloth above the skin is free.
        lift = jnp.where(high > 0.9 * _FREE, jnp.maximum(lift, 0.0), lift)
        moved = displacement + lift * n
        # Friction opposes the motion relative to the skin in this substep.
        slide = (moved - start) - step.share * surface.way
        slide = slide - jnp.sum(slide * n, axis=1, keepdims=True) * n
        length = jnp.sqrt(jnp.sum(slide * slide, axis=1, keepdims=True) + 1e-18)
        hold = jnp.minimum(1.0, self.friction[points][..., None] * jnp.abs(lift) / length)
        return moved - hold * slide, lift

    def diagnose(self, displacement: Array, context: _Touch) -> dict[str, Array]:
        surface = jax.tree.map(
            lambda x, y: jnp.concatenate([x, y]), context.surface, context.beside
        )
        points = self.samples.extend(displacement)
        height = surface.height_of(points, jnp.ones((), displacement.dtype))[1]
        # Depth below the skin or, in a pinch, below a thickness under its middle.
        wanted = surface.height + surface.rise
        inside = (wanted - context.margin - height)[:, 0]
        return {
            "penetration_max": jnp.maximum(inside.max(axis=0), 0.0),
            "inside_share": jnp.mean((inside > 0).astype(displacement.dtype), axis=0),
            # Far from the skin the choice of the closest point doesn't matter.
            "missed": jnp.sum(context.missed & (inside > -0.02), axis=0),
            "pinched": jnp.sum(wanted[:, 0] < 0, axis=0),
        }


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
