"""Contact with the body: closest point on a local patch, Coulomb friction."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.spatial import KDTree

from ...body import NUM_BODY_VERTICES, Body, triangulate
from ...geometry import closest_barycentric, spread_points, vertex_normals
from ...typing import pytree
from .._assembly import Assembly, float32
from .._effect import Attached, Clock, Effect, Placed, Prepared

# Groups of joints between which a tight garment doesn't slide.
_LIMBS = {
    "LeftLeg": ("LeftUpLeg", "LeftLeg", "LeftFoot", "LeftToeBase"),
    "RightLeg": ("RightUpLeg", "RightLeg", "RightFoot", "RightToeBase"),
    "LeftArm": (
        "LeftArm",
        "LeftForeArm",
        "LeftHand",
        "LThumb",
        "LeftFingerBase",
        "LeftHandFinger1",
    ),
    "RightArm": (
        "RightArm",
        "RightForeArm",
        "RightHand",
        "RThumb",
        "RightFingerBase",
        "RightHandFinger1",
    ),
}


@dataclasses.dataclass(frozen=True)
class BodyContact(Effect):
    """Cloth keeps its thickness from the skin and rubs against it.

    Once a block, each cloth vertex finds its closest skin point; within the block the
    point and its normal move with the skin, and the half space beyond them is closed,
    however fast the limb: nothing tunnels.

    Cloth that lies on the skin *tracks* it: the search starts at the skin point of the
    block before and walks over the surface, so the cloth may slide any distance but never
    jumps to the far side of a limb, to another limb, or across a fold where the body
    passes through itself. Cloth pinched between two limbs keeps to its own. Hanging
    cloth compares a list of patches over all limbs within reach instead.

    Attributes:
        patch: Triangles around a skin vertex that are compared exactly.
        hops: Steps of the walk a block; each reaches about two centimetres.
        centres: Patches in the list of a hanging vertex.
        spacing: Distance between them [m].
        push: Largest correction in one substep [m].
        leave: Cloth that was lifted leaves the skin no faster than this [m/s]: what was
            squeezed into a limb is set down outside instead of being shot away.

    References:
        Macklin et al. (2016) for the projection; friction as a clamped tangential
        move, Mueller et al., Position based dynamics (2007), section 3.4.
    """

    patch: int = 24
    hops: int = 2
    centres: int = 96
    spacing: float = 0.026
    push: float = 1.0
    leave: float = 1.0

    def __post_init__(self) -> None:
        if min(self.patch, self.hops, self.centres) < 1 or self.spacing <= 0 or self.push <= 0:
            raise ValueError(f"{self}: patch, hops, centres, spacing and push must be positive.")

    def prepare(self, assembly: Assembly, inverse_mass: Array) -> Prepared:
        """Patches around skin vertices, and where each cloth vertex starts."""
        body = assembly.body
        skin = assembly.rest_body[:NUM_BODY_VERTICES]
        faces = np.asarray(triangulate(body.quads))
        weights = np.asarray(body.weights)[:NUM_BODY_VERTICES]
        label = _limb_labels(weights, body)
        loose = np.flatnonzero(assembly.loose)
        tight = np.flatnonzero(~assembly.loose)
        # Only skin that cloth can get to takes part: far parts are not even skinned.
        reach = KDTree(assembly.rest).query(skin, distance_upper_bound=_REACH)[0]
        used = np.flatnonzero(np.isfinite(reach))
        if len(used) < 3 * self.patch:
            used = np.arange(len(skin))
        start = _start(assembly, skin, used, label, tight)
        listed = _listed(assembly, skin, used, loose, self.spacing, self.centres)
        kept = np.flatnonzero(np.isin(faces, used).all(axis=1))
        size = min(self.patch, len(kept))
        far, near = KDTree(skin[faces[kept]].mean(axis=1)).query(skin[used], k=size)
        local = np.zeros(len(skin), dtype=np.int32)
        local[used] = np.arange(len(used))
        normals = vertex_normals(float32(skin), jnp.asarray(faces))
        attached = Attached(
            float32(skin[used]), normals[jnp.asarray(used)], body.weights[jnp.asarray(used)]
        )
        w = np.asarray(inverse_mass)
        return _Contact(
            attached,
            jnp.asarray(near.reshape(len(used), size).astype(np.int32)),
            float32(far.reshape(len(used), size)[:, -1]),
            jnp.asarray(local[faces[kept]]),
            jnp.asarray(tight.astype(np.int32)),
            jnp.asarray(loose.astype(np.int32)),
            jnp.asarray(local[start]),
            jnp.asarray(local[listed]),
            float32(assembly.thickness)[:, None],
            float32(assembly.friction)[:, None],
            float32(w > 0)[:, None],
            self.push,
            self.leave,
            self.hops,
        )


# Cloth this little above its thickness touches the skin [m].
_NEAR = 0.001
# Skin farther than this from all cloth at rest takes no part [m].
_REACH = 0.30


def _start(
    assembly: Assembly,
    skin: Float[np.ndarray, "body 3"],
    used: Int[np.ndarray, " used"],
    label: Int[np.ndarray, " body"],
    rows: Int[np.ndarray, " tight"],
) -> Int[np.ndarray, " tight"]:
    """The skin vertex nearest to each cloth vertex at rest, on its own limb."""
    cloth = _limb_labels(assembly.weights, assembly.body)[rows]
    out = np.zeros(len(rows), dtype=np.int64)
    for lab in np.unique(cloth):
        mine = cloth == lab
        # Arms and legs keep to themselves; the trunk's cloth may start anywhere.
        pool = used if lab == 0 else used[(label[used] == lab) | (label[used] == 0)]
        pool = pool if len(pool) else used
        out[mine] = pool[KDTree(skin[pool]).query(assembly.rest[rows[mine]])[1]]
    return out


def _listed(
    assembly: Assembly,
    skin: Float[np.ndarray, "body 3"],
    used: Int[np.ndarray, " used"],
    rows: Int[np.ndarray, " loose"],
    spacing: float,
    count: int,
) -> Int[np.ndarray, "loose k"]:
    """Skin vertices whose patches a hanging vertex compares."""
    pool = used[spread_points(skin[used], spacing)]
    k = min(count, len(pool))
    return pool[KDTree(skin[pool]).query(assembly.rest[rows], k=k)[1].reshape(len(rows), k)]


def _limb_labels(
    weights: Float[np.ndarray, "points joints"], body: Body
) -> Int[np.ndarray, " points"]:
    """0 for the trunk, else the limb that carries most of the weight."""
    share = np.stack(
        [weights[:, [body.joint(n) for n in names]].sum(axis=1) for names in _LIMBS.values()],
        axis=1,
    )
    return np.where(share.max(axis=1) > 0.5, share.argmax(axis=1) + 1, 0)


@pytree
@dataclasses.dataclass(frozen=True)
class _Contact(Prepared):
    skin: Attached
    table: Int[Array, "skin patch"]
    radius: Float[Array, " skin"]
    faces: Int[Array, "faces 3"]
    tight: Int[Array, " tight"]
    loose: Int[Array, " loose"]
    start: Int[Array, " tight"]
    listed: Int[Array, "loose k"]
    thickness: Float[Array, "vertices 1"]
    friction: Float[Array, "vertices 1"]
    free: Float[Array, "vertices 1"]
    push: float = dataclasses.field(metadata={"static": True})
    leave: float = dataclasses.field(metadata={"static": True})
    hops: int = dataclasses.field(metadata={"static": True})

    @property
    def attached(self) -> Attached:
        return self.skin

    def initial(self, batch: int) -> Int[Array, "tight batch"]:
        return jnp.repeat(self.start[:, None], batch, axis=1)

    def keep(self, context: tuple[Array, ...]) -> Array:
        return context[4]

    def closest(
        self,
        points: Float[Array, "some 3 batch"],
        skin: Float[Array, "skin 3 batch"],
        centre: Int[Array, "some batch"],
    ) -> tuple[Array, Array, Array, Array]:
        """Closest point on the patch around a skin vertex.

        Returns:
            Face, barycentric weights [3, some, batch], the face's corner nearest to
            the point, and the squared distance.
        """
        lane = jnp.arange(points.shape[2])[None]
        patch = self.table[centre]
        corners = [skin[self.faces[patch][..., k], :, lane[..., None]] for k in range(3)]
        # [some, batch, patch] with the component first for element-wise work.
        corners = [jnp.moveaxis(c, -1, 0) for c in corners]
        p = jnp.broadcast_to(jnp.moveaxis(points, 1, 0)[..., None], corners[0].shape)
        weights, squared = closest_barycentric(p, *corners)
        best = jnp.argmin(squared, axis=2)
        face = jnp.take_along_axis(patch, best[..., None], axis=2)[..., 0]
        weights = jnp.take_along_axis(weights, best[None, ..., None], axis=3)[..., 0]
        squared = jnp.take_along_axis(squared, best[..., None], axis=2)[..., 0]
        corner = jnp.take_along_axis(
            self.faces[face], jnp.argmax(weights, axis=0)[..., None], axis=2
        )[..., 0]
        stop = jax.lax.stop_gradient
        return stop(face), weights, stop(corner), squared

    def begin(
        self, base: Array, start: Placed, end: Placed, clock: Clock, memory: Array
    ) -> tuple[Array, ...]:
        tight = base[self.tight]
        centre = memory
        for _ in range(self.hops):
            last = centre
            face, weights, centre, _ = self.closest(tight, start.points, last)
        if self.loose.shape[0]:
            loose = base[self.loose]
            gap = start.points[self.listed] - loose[:, None]
            pick = jnp.argmin(jnp.sum(gap * gap, axis=2), axis=1)
            middle = jnp.take_along_axis(self.listed, pick, axis=1)
            # The middle's own patch may be smaller than the list's mesh: walk on from there.
            for _ in range(self.hops):
                there = middle
                more, other, middle, _ = self.closest(loose, start.points, there)
            order = jnp.argsort(jnp.concatenate([self.tight, self.loose]))
            face = jnp.concatenate([face, more])[order]
            weights = jnp.concatenate([weights, other], axis=1)[:, order]
            last = jnp.concatenate([last, there])[order]
        p0, n0 = _surface(start, self.faces, face, weights)
        p1, n1 = _surface(end, self.faces, face, weights)
        lane = jnp.arange(base.shape[2])[None]
        from_middle = p0 - jnp.moveaxis(start.points[last, :, lane], -1, 1)
        far = jnp.sum(from_middle**2, axis=1) > self.radius[last] ** 2
        unit = n0 / jnp.sqrt(jnp.sum(n0 * n0, axis=1, keepdims=True) + 1e-12)
        height = jnp.sum((base - p0) * unit, axis=1, keepdims=True)
        touching = height < self.thickness[..., None] + _NEAR
        fastest = jnp.sum((p1 - p0) * unit, axis=1, keepdims=True) / clock.length + self.leave
        ceiling = jnp.where(touching, fastest, jnp.inf)
        return p0 - base, p1 - p0, n0, n1 - n0, centre, far, unit, ceiling

    def accelerate(self, velocity: Array, context: tuple[Array, ...], h: float) -> Array:
        unit, ceiling = context[6:]
        outwards = jnp.sum(velocity * unit, axis=1, keepdims=True)
        return velocity - jnp.maximum(outwards - ceiling, 0.0) * unit

    def project(
        self,
        displacement: Array,
        start: Array,
        context: tuple[Array, ...],
        progress: Array,
        step: tuple[float, float],
    ) -> Array:
        n, depth = self._depth(displacement, context, progress)
        lift = jnp.clip(depth, 0.0, self.push) * self.free[..., None]
        moved = displacement + lift * n
        # Friction acts against the skin's own way in this substep.
        slide = (moved - start) - step[1] * context[1]
        slide = slide - jnp.sum(slide * n, axis=1, keepdims=True) * n
        length = jnp.sqrt(jnp.sum(slide * slide, axis=1, keepdims=True) + 1e-18)
        hold = jnp.minimum(1.0, self.friction[..., None] * lift / length)
        return moved - hold * slide

    def _depth(
        self, displacement: Array, context: tuple[Array, ...], progress: Array
    ) -> tuple[Array, Array]:
        """Unit normals, and how much of the thickness is missing [m]."""
        where, way, normal, turn = context[:4]
        n = normal + progress * turn
        n = n / jnp.sqrt(jnp.sum(n * n, axis=1, keepdims=True) + 1e-12)
        gap = displacement - (where + progress * way)
        height = jnp.sum(gap * n, axis=1, keepdims=True)
        return n, self.thickness[..., None] - height

    def diagnose(self, displacement: Array, context: tuple[Array, ...]) -> dict[str, Array]:
        depth = self._depth(displacement, context, jnp.ones((), displacement.dtype))[1]
        inside = depth[:, 0] - self.thickness
        return {
            "penetration_max": jnp.maximum(inside.max(axis=0), 0.0),
            "inside_share": jnp.mean((inside > 0).astype(displacement.dtype), axis=0),
            # Far from the skin it doesn't matter which point is the closest.
            "missed": jnp.sum(context[5] & (inside > -0.02), axis=0),
        }


def _surface(skin: Placed, faces: Array, face: Array, weights: Array) -> tuple[Array, Array]:
    """Points and smooth normals of the skin, shape [vertices, 3, batch]."""
    lane = jnp.arange(skin.points.shape[2])[None]
    tri = faces[face]
    point = normal = jnp.zeros((), skin.points.dtype)
    for k in range(3):
        w = weights[k][:, None]
        point = point + w * jnp.moveaxis(skin.points[tri[..., k], :, lane], -1, 1)
        normal = normal + w * jnp.moveaxis(skin.normals[tri[..., k], :, lane], -1, 1)
    return point, normal
