"""Collisions of hanging cloth: the skin that a skirt may touch, and how it clears it."""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.spatial import KDTree

from ...body import NUM_BODY_VERTICES, Body
from ...garment import SkinnedGarment
from ...geometry import (
    Stencil,
    TriMesh,
    closest_among,
    nearest_indices,
    safe_normalize,
    spread_points,
    vertex_normals,
)
from ...typing import pytree

# Skin points compared for each vertex, their spacing [m], and the triangles around each.
_NUM_CHOICES, _SPACING, _NUM_TRIANGLES = 96, 0.03, 20
# Triangles compared exactly: those with the nearest middles.
_NUM_EXACT = 3
# Minimum cosine between the outward direction and the normal of skin in front of a vertex.
_MIN_COSINE = 0.25
# Squared distance of a skin point from the line along the outward direction: contact is full
# below the first, absent above the second [m^2].
_FULL_CONTACT, _NO_CONTACT = 0.03**2, 0.05**2
# Maximum distance that a leg carries cloth [m].
_MAX_CARRY = 0.25
_EXCLUDED = 1e3


@pytree
@dataclasses.dataclass(frozen=True)
class SkirtCollider:
    """Skin that hanging cloth may touch: both legs, hips and belly.

    Attributes:
        rows: Hanging garment vertices, shape [hanging].
        lying: All other garment vertices, shape [lying].
        order: Index of each vertex in ``lying`` followed by ``rows``, shape [vertices].
        outward: Unit direction out of the skirt at rest, shape [hanging, 3].
        weights: Skinning weights of the hanging vertices, shape [hanging, joints].
        middles: Skin vertices at the middle of each patch, shape [patches].
        near: Patches compared with each vertex, the nearest at rest first, shape [c, hanging].
        table: Triangles around each of them, shape [patches, k].
    """

    rows: Int[Array, " hanging"]
    lying: Int[Array, " lying"]
    order: Int[Array, " vertices"]
    outward: Float[Array, "hanging 3"]
    weights: Float[Array, "hanging joints"]
    middles: Int[Array, " patches"]
    near: Int[Array, "c hanging"]
    table: Int[Array, "patches k"]


def hanging_vertices(
    body: Body, rest: Float[np.ndarray, "all 3"], points: Float[np.ndarray, "points 3"]
) -> Int[np.ndarray, " hanging"]:
    """Vertices of a dress that hang: those below the hips."""
    joint_positions = rest[np.asarray(body.joint_rows)].mean(axis=2)[:, 0]
    return np.flatnonzero(points[:, 1] < joint_positions[body.joint("LeftUpLeg"), 1] + 0.05)


def make_skirt_collider(
    body: Body,
    rest: Float[Array, "all 3"],
    worn: SkinnedGarment,
    faces: Int[np.ndarray, "faces 3"],
    garment: TriMesh,
    carry: Stencil,
) -> SkirtCollider:
    """Lists the skin near each hanging vertex, over legs, hips and belly.

    Args:
        body: The body.
        rest: Its rest vertices on the default shape [m].
        worn: A dress.
        faces: Triangles of the whole body.
        garment: The dress's mesh on that shape.
        carry: Mean over neighbourhoods of the dress.

    Returns:
        The collider, with indices of body vertices and faces.
    """
    skin = np.asarray(rest)[:NUM_BODY_VERTICES]
    points = np.asarray(garment.vertices)
    rows = hanging_vertices(body, np.asarray(rest), points)
    normals = vertex_normals(points, np.asarray(garment.faces))
    outward = safe_normalize(np.asarray(carry @ jax.device_put(normals)))[rows]
    # In some files faces are oriented inward.
    if len(rows):
        middle = points[rows].mean(axis=0) * [1, 0, 1]
        outward *= np.sign(np.mean(np.sum(outward * (points[rows] - middle), axis=1)))
    below = np.flatnonzero(_lower_body_weights(body)[:NUM_BODY_VERTICES] > 0.3)
    chosen = below[spread_points(skin[below], _SPACING)]
    k = min(_NUM_CHOICES, len(chosen))
    near = KDTree(skin[chosen]).query(points[rows], k=k)[1].reshape(len(rows), k)
    # Skin points that no vertex uses would cost as much as the others.
    if len(rows):
        kept, near = np.unique(near, return_inverse=True)
        chosen, near = chosen[kept], near.reshape(len(rows), k)
    table = KDTree(skin[faces].mean(axis=1)).query(skin[chosen], k=_NUM_TRIANGLES)[1]
    lying = np.setdiff1d(np.arange(len(points)), rows)
    return SkirtCollider(
        jax.device_put(rows.astype(np.int32)),
        jax.device_put(lying.astype(np.int32)),
        jax.device_put(np.argsort(np.concatenate([lying, rows])).astype(np.int32)),
        jax.device_put(outward),
        worn.skin[jax.device_put(rows)],
        jax.device_put(chosen.astype(np.int32)),
        jax.device_put(near.T.astype(np.int32)),
        jax.device_put(table.astype(np.int32)),
    )


def _lower_body_weights(body: Body) -> Float[np.ndarray, " all"]:
    legs = ("UpLeg", "Leg", "Foot", "ToeBase")
    names = [f"{side}{n}" for side in ("Left", "Right") for n in legs]
    # The belly is inside the skirt when the person bends over.
    names += ["Hips", "LHipJoint", "RHipJoint", "LowerBack"]
    return np.asarray(body.weights)[:, [body.joint(n) for n in names]].sum(axis=1)


class SkirtContacts(NamedTuple):
    """Possible contacts of hanging vertices: at the vertex, and along its outward direction.

    Attributes:
        points: Query points for the closest skin: the vertices, and the points level with
            the skin in front of them along the outward direction [m], shape [hanging, 3] each.
        candidates: Triangles compared for each, shape [hanging, k] each.
        cost: Squared distance of the outward line from the skin in front [m^2], shape
            [hanging].
    """

    points: tuple[Float[Array, "hanging 3"], Float[Array, "hanging 3"]]
    candidates: tuple[Int[Array, "hanging k"], Int[Array, "hanging k"]]
    cost: Float[Array, " hanging"]


def skirt_contacts(
    collider: SkirtCollider,
    points: Float[Array, "hanging 3"],
    outward: Float[Array, "hanging 3"],
    skin: Float[Array, "skin 3"],
    normals: Float[Array, "skin 3"],
) -> SkirtContacts:
    """Finds the skin nearest to hanging vertices, and the skin in front of them.

    Args:
        collider: The skin that they may touch.
        points: Hanging vertices [m].
        outward: Unit direction out of the skirt in this pose.
        skin: Skin vertices in this pose [m].
        normals: Their normals.
    """
    # Coordinate by coordinate with points last, for speed on CPUs. The choice of skin points
    # needs no derivative.
    p, direction, m, n = jax.lax.stop_gradient(
        (points.T, outward.T, skin[collider.middles].T, normals[collider.middles].T)
    )
    gaps = [x[collider.near] - q[None] for x, q in zip(m, p, strict=True)]
    facings = [x[collider.near] for x in n]
    along, facing, squared = (
        a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
        for a, b in ((gaps, direction[:, None]), (facings, direction[:, None]), (gaps, gaps))
    )
    # Skin in front of the vertex, along the outward direction.
    in_front = (facing > _MIN_COSINE) & (along > -_SPACING) & (along < _MAX_CARRY)
    beside = jnp.where(in_front, jnp.maximum(squared - along * along, 0.0), _EXCLUDED)
    choices = nearest_indices(squared, beside)
    nearest, pick = (jnp.take_along_axis(collider.near, x[None], axis=0)[0] for x in choices)
    gap = skin[collider.middles[pick]] - points
    reach = jnp.sum(gap * outward, axis=1)
    # The root of the cost is the distance of that skin point from the outward line.
    cost = jnp.sum(gap * gap, axis=1) - reach * reach
    cost = jnp.where(jnp.any(in_front, axis=0), cost, _NO_CONTACT)
    level = points + reach[:, None] * outward
    return SkirtContacts((points, level), (collider.table[nearest], collider.table[pick]), cost)


def skirt_correction(
    contacts: SkirtContacts,
    outward: Float[Array, "hanging 3"],
    near: tuple[Float[Array, "hanging 3"], Float[Array, "hanging 3"]],
    front: tuple[Float[Array, "hanging 3"], Float[Array, "hanging 3"]],
    least: Float[Array, " hanging"],
) -> tuple[Float[Array, "hanging 3"], Float[Array, " hanging"]]:
    """Computes how hanging vertices move to clear the legs.

    A leg in front of a vertex, along the outward direction, carries it: a leg that moves
    forward takes the front of the skirt along instead of penetrating it. Beside a leg, the
    vertex keeps its clearance from the nearest skin. The two displacements are blended.

    Args:
        contacts: Possible contacts with the legs.
        outward: Unit direction out of the skirt in this pose.
        near: `closest_skin_point` of the vertices.
        front: `closest_skin_point` of the points along the outward direction.
        least: Minimum height above the skin [m].

    Returns:
        Displacements [m] and heights above the nearest skin [m].
    """
    points, cost = contacts.points[0], contacts.cost
    closest, near_normal = near
    height = jnp.sum((points - closest) * near_normal, axis=1)
    near_move = jnp.maximum(least - height, 0.0)[:, None] * near_normal
    closest, normal = front
    slope = jnp.maximum(jnp.sum(normal * outward, axis=1), _MIN_COSINE)
    distance = (jnp.sum((closest - points) * normal, axis=1) + least) / slope
    share = jnp.clip((_NO_CONTACT - cost) / (_NO_CONTACT - _FULL_CONTACT), 0.0, 1.0)
    share = (share * share * (3 - 2 * share))[:, None]
    front_move = jnp.clip(distance, 0.0, _MAX_CARRY)[:, None] * outward
    return near_move + share * (front_move - near_move), height


def closest_skin_point(
    skin: Float[Array, "skin 3"],
    normals: Float[Array, "skin 3"],
    faces: Int[Array, "faces 3"],
    points: Float[Array, "points 3"],
    candidates: Int[Array, "points k"],
) -> tuple[Float[Array, "points 3"], Float[Array, "points 3"]]:
    """Finds the closest points on the skin [m] and its smooth unit normals there.

    Args:
        skin: Skin vertices in this pose [m].
        normals: Their normals.
        faces: Triangles of these vertices.
        points: Query points [m].
        candidates: Triangles compared for each point.
    """
    hit = closest_among(TriMesh(skin, faces), points, candidates, exactly=_NUM_EXACT)
    tri = faces[hit.face]
    closest = jnp.einsum("pk,pkx->px", hit.weights, skin[tri], precision=jax.lax.Precision.HIGHEST)
    return closest, safe_normalize(
        jnp.einsum("pk,pkx->px", hit.weights, normals[tri], precision=jax.lax.Precision.HIGHEST)
    )
