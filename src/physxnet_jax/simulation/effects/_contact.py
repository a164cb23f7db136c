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
from .._effect import Attached, Effect, Placed, Prepared

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

    Once a block, each cloth vertex finds its closest skin point: the nearest of a list
    of patch centres, then the exact closest point on that patch's triangles. Within
    the block the point and its normal move with the skin. Patches of other limbs are
    left out, so that nothing grabs across the crotch; skirts may meet both legs.

    Attributes:
        centres: Patch centres compared for each vertex.
        spacing: Distance between centres [m].
        patch: Triangles of a patch.
        push: Largest correction in one substep [m]: pinched cloth is squeezed out
            gently instead of being shot away.

    References:
        Macklin et al. (2016) for the projection; friction as a clamped tangential
        move, Mueller et al., Position based dynamics (2007), section 3.4.
    """

    centres: int = 96
    spacing: float = 0.016
    patch: int = 24
    push: float = 0.004

    def prepare(self, assembly: Assembly, inverse_mass: Array) -> Prepared:
        """Lists the patch centres of every cloth vertex."""
        body = assembly.body
        skin = assembly.rest_body[:NUM_BODY_VERTICES]
        faces = np.asarray(triangulate(body.quads))
        label = _limb_labels(np.asarray(body.weights)[:NUM_BODY_VERTICES], body)
        candidates, table = _patches(
            assembly, skin, faces, label, self.centres, self.spacing, self.patch
        )
        w = np.asarray(inverse_mass)
        used = np.unique(candidates)
        rows = np.unique(faces[table[used]])
        local = np.zeros(len(skin), dtype=np.int32)
        local[rows] = np.arange(len(rows))
        mesh_normals = vertex_normals(float32(skin), jnp.asarray(faces))
        attached = Attached(
            float32(skin[rows]),
            mesh_normals[jnp.asarray(rows)],
            body.weights[jnp.asarray(rows)],
        )
        return _Contact(
            attached,
            jnp.asarray(local[candidates]),
            jnp.asarray(table[rows]),
            jnp.asarray(local[faces]),
            float32(assembly.thickness)[:, None],
            float32(assembly.friction)[:, None],
            float32(w > 0)[:, None],
            self.push,
        )


def _limb_labels(
    weights: Float[np.ndarray, "points joints"], body: Body
) -> Int[np.ndarray, " points"]:
    """0 for the trunk, else the limb that carries most of the weight."""
    share = np.stack(
        [weights[:, [body.joint(n) for n in names]].sum(axis=1) for names in _LIMBS.values()],
        axis=1,
    )
    return np.where(share.max(axis=1) > 0.5, share.argmax(axis=1) + 1, 0)


def _patches(
    assembly: Assembly,
    skin: Float[np.ndarray, "body 3"],
    faces: Int[np.ndarray, "faces 3"],
    label: Int[np.ndarray, " body"],
    count: int,
    spacing: float,
    size: int,
) -> tuple[Int[np.ndarray, "vertices k"], Int[np.ndarray, "centres patch"]]:
    """Centres for each cloth vertex (as body vertices) and the triangles of each."""
    tight = spread_points(skin, spacing)
    wide = spread_points(skin, 1.6 * spacing)
    cloth_label = _limb_labels(assembly.weights, assembly.body)
    out = np.zeros((len(assembly.rest), count), dtype=np.int32)
    for lab in range(5):
        for loose in (False, True):
            rows = np.flatnonzero((cloth_label == lab) & (assembly.loose == loose))
            if len(rows) == 0:
                continue
            # Below the waist a skirt meets both legs; a trouser leg meets only its own.
            pool = wide if loose else tight
            if lab in (1, 2) and not loose:
                pool = pool[label[pool] != 3 - lab]
            k = min(count, len(pool))
            near = KDTree(skin[pool]).query(assembly.rest[rows], k=k)[1].reshape(-1, k)
            out[rows] = pool[near][:, np.minimum(np.arange(count), k - 1)]
    middles = skin[faces].mean(axis=1)
    size = min(size, len(faces))
    table = np.zeros((len(skin), size), dtype=np.int32)
    used = np.unique(out)
    table[used] = KDTree(middles).query(skin[used], k=size)[1].reshape(-1, size)
    return out, table


@pytree
@dataclasses.dataclass(frozen=True)
class _Contact(Prepared):
    skin: Attached
    candidates: Int[Array, "vertices k"]
    table: Int[Array, "body patch"]
    faces: Int[Array, "faces 3"]
    thickness: Float[Array, "vertices 1"]
    friction: Float[Array, "vertices 1"]
    free: Float[Array, "vertices 1"]
    push: float = dataclasses.field(metadata={"static": True})

    def closest(
        self, points: Float[Array, "vertices 3 batch"], skin: Float[Array, "body 3 batch"]
    ) -> tuple[Int[Array, "vertices batch"], Float[Array, "3 vertices batch"]]:
        """Closest face and barycentric weights of each vertex."""
        lane = jnp.arange(points.shape[2])[None]
        gap = skin[self.candidates] - points[:, None]
        squared = jnp.sum(gap * gap, axis=2)
        pick = jnp.argmin(squared, axis=1)
        centre = jnp.take_along_axis(self.candidates, pick, axis=1)
        patch = self.table[centre]
        corners = [skin[self.faces[patch][..., k], :, lane[..., None]] for k in range(3)]
        # [vertices, batch, patch, 3] with the component first for element-wise work.
        corners = [jnp.moveaxis(c, -1, 0) for c in corners]
        p = jnp.moveaxis(points, 1, 0)[..., None]
        p = jnp.broadcast_to(p, corners[0].shape)
        weights, distance = closest_barycentric(p, *corners)
        best = jnp.argmin(distance, axis=2)
        face = jnp.take_along_axis(patch, best[..., None], axis=2)[..., 0]
        weights = jnp.take_along_axis(weights, best[None, ..., None], axis=3)[..., 0]
        return jax.lax.stop_gradient(face), weights

    @property
    def attached(self) -> Attached:
        return self.skin

    def begin(self, base: Array, start: Placed, end: Placed) -> tuple[Array, ...]:
        face, weights = self.closest(base, start.points)
        p0, n0 = _surface(start, self.faces, face, weights)
        p1, n1 = _surface(end, self.faces, face, weights)
        return p0 - base, p1 - p0, n0, n1 - n0

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
        where, way, normal, turn = context
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
