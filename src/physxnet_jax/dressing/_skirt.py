"""The body in a skirt: which skin a hanging vertex may meet, and the way out of it."""

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.spatial import KDTree

from ..body import NUM_BODY_VERTICES, Body
from ..geometry import (
    Stencil,
    TriMesh,
    closest_among,
    least_index,
    safe_normalize,
    spread_points,
    vertex_normals,
)
from ..models import Wearable
from ..typing import pytree

# Skin points compared for each vertex, their distance, and the triangles of each [m].
_CHOICES, _SPACING, _PATCH = 96, 0.03, 20
# Skin counts as being in front where it faces the way out by at least this cosine.
_FACING = 0.25
# A leg is met in full where the way out passes this near a skin point, not at all where
# it stays this far [m^2].
_HIT, _MISS = 0.03**2, 0.05**2
# Cloth isn't carried farther than this by a leg [m].
_FARTHEST = 0.25
_NOWHERE = 1e3


@pytree
@dataclasses.dataclass(frozen=True)
class SkirtPatch:
    """Skin that hanging cloth may meet: both legs, hips and belly.

    Attributes:
        rows: Hanging garment vertices, shape [hanging].
        lying: All others, shape [lying].
        order: Where each vertex stands in ``lying`` followed by ``rows``, shape [vertices].
        outward: The way out of the skirt at rest, unit, shape [hanging, 3].
        weights: Skinning weights of the hanging vertices, shape [hanging, joints].
        compared: Which of ``middles`` each is compared with, shape [hanging, patches].
        middles: Skin vertices that are compared, shape [patches].
        table: Triangles around each of them, shape [patches, k].
    """

    rows: Int[Array, " hanging"]
    lying: Int[Array, " lying"]
    order: Int[Array, " vertices"]
    outward: Float[Array, "hanging 3"]
    weights: Float[Array, "hanging joints"]
    compared: Bool[Array, "hanging patches"]
    middles: Int[Array, " patches"]
    table: Int[Array, "patches k"]


def hanging_vertices(
    body: Body, rest: Float[np.ndarray, "all 3"], points: Float[np.ndarray, "points 3"]
) -> Int[np.ndarray, " hanging"]:
    """Vertices of a dress below the hips."""
    heads = rest[np.asarray(body.joint_rows)].mean(axis=2)[:, 0]
    return np.flatnonzero(points[:, 1] < heads[body.joint("LeftUpLeg"), 1] + 0.05)


def make_skirt_patch(
    body: Body,
    rest: Float[Array, "all 3"],
    wearable: Wearable,
    faces: Int[np.ndarray, "faces 3"],
    garment: TriMesh,
    carry: Stencil,
) -> SkirtPatch:
    """Lists the skin near each hanging vertex, over legs, hips and belly.

    Args:
        body: The body.
        rest: Its rest vertices on the default shape [m].
        wearable: A dress.
        faces: Triangles of the whole body.
        garment: The dress's mesh on that shape.
        carry: Mean over neighbourhoods of the dress.

    Returns:
        The patch, in terms of body vertices and faces.
    """
    skin = np.asarray(rest)[:NUM_BODY_VERTICES]
    points = np.asarray(garment.vertices)
    rows = hanging_vertices(body, np.asarray(rest), points)
    normals = carry @ vertex_normals(garment.vertices, garment.faces)
    outward = np.asarray(safe_normalize(normals))[rows]
    # Some files have their faces inside out.
    if len(rows):
        middle = points[rows].mean(axis=0) * [1, 0, 1]
        outward *= np.sign(np.mean(np.sum(outward * (points[rows] - middle), axis=1)))
    below = np.flatnonzero(_share_below_waist(body)[:NUM_BODY_VERTICES] > 0.3)
    chosen = below[spread_points(skin[below], _SPACING)]
    k = min(_CHOICES, len(chosen))
    near = KDTree(skin[chosen]).query(points[rows], k=k)[1].reshape(len(rows), k)
    # Those that nothing is near cost as much as all others.
    if len(rows):
        kept, near = np.unique(near, return_inverse=True)
        chosen, near = chosen[kept], near.reshape(len(rows), k)
    compared = np.zeros((len(rows), len(chosen)), dtype=bool)
    np.put_along_axis(compared, near, True, axis=1)
    table = KDTree(skin[faces].mean(axis=1)).query(skin[chosen], k=_PATCH)[1]
    lying = np.setdiff1d(np.arange(len(points)), rows)
    return SkirtPatch(
        jnp.asarray(rows.astype(np.int32)),
        jnp.asarray(lying.astype(np.int32)),
        jnp.asarray(np.argsort(np.concatenate([lying, rows])).astype(np.int32)),
        jnp.asarray(outward),
        wearable.skin[jnp.asarray(rows)],
        jnp.asarray(compared),
        jnp.asarray(chosen.astype(np.int32)),
        jnp.asarray(table.astype(np.int32)),
    )


def _share_below_waist(body: Body) -> Float[np.ndarray, " all"]:
    legs = ("UpLeg", "Leg", "Foot", "ToeBase")
    names = [f"{side}{n}" for side in ("Left", "Right") for n in legs]
    # Whoever bends over has the belly in the skirt.
    names += ["Hips", "LHipJoint", "RHipJoint", "LowerBack"]
    return np.asarray(body.weights)[:, [body.joint(n) for n in names]].sum(axis=1)


class Meeting(NamedTuple):
    """Where hanging vertices may meet the legs: each by itself, and along its way out.

    Attributes:
        points: From where the nearest skin is looked for: the vertices, and the places on
            their way out that are beside skin in front of them [m], shape [hanging, 3] each.
        candidates: Triangles compared for each, shape [hanging, k] each.
        cost: Squared distance at which the way out passes that skin [m^2], shape [hanging].
    """

    points: tuple[Float[Array, "hanging 3"], Float[Array, "hanging 3"]]
    candidates: tuple[Int[Array, "hanging k"], Int[Array, "hanging k"]]
    cost: Float[Array, " hanging"]


def skirt_meeting(
    patch: SkirtPatch,
    points: Float[Array, "hanging 3"],
    outward: Float[Array, "hanging 3"],
    skin: Float[Array, "skin 3"],
    normals: Float[Array, "skin 3"],
) -> Meeting:
    """Which skin hanging vertices are near, and which is in front of them.

    Args:
        patch: The legs.
        points: Hanging vertices [m].
        outward: The way out of the skirt in this pose, unit.
        skin: Skin vertices in this pose [m].
        normals: Their normals.
    """
    # All pairs as products of matrices, about a point among them, where sums of squares are
    # precise; which skin point is taken needs no derivative.
    dense = functools.partial(jnp.matmul, precision=jax.lax.Precision.HIGHEST)
    about = jax.lax.stop_gradient(jnp.mean(points, axis=0, keepdims=True))
    p, way_out, m, n = jax.lax.stop_gradient(
        (points - about, outward, skin[patch.middles] - about, normals[patch.middles])
    )
    along = dense(way_out, m.T) - jnp.sum(p * way_out, axis=1)[:, None]
    facing = dense(way_out, n.T)
    squared = jnp.sum(p * p, axis=1)[:, None] + jnp.sum(m * m, axis=1)[None] - 2.0 * dense(p, m.T)
    nearest = _least(squared, patch.compared)
    # Skin in front of the vertex, seen along the way out.
    ahead = patch.compared & (facing > _FACING) & (along > -_SPACING) & (along < _FARTHEST)
    pick = _least(squared - along * along, ahead)
    gap = skin[patch.middles[pick]] - points
    reach = jnp.sum(gap * outward, axis=1)
    # The way out passes beside that skin point by the root of the cost.
    cost = jnp.sum(gap * gap, axis=1) - reach * reach
    cost = jnp.where(jnp.any(ahead, axis=1), cost, _MISS)
    beside = points + reach[:, None] * outward
    return Meeting((points, beside), (patch.table[nearest], patch.table[pick]), cost)


def skirt_lift(
    meeting: Meeting,
    outward: Float[Array, "hanging 3"],
    near: tuple[Float[Array, "hanging 3"], Float[Array, "hanging 3"]],
    front: tuple[Float[Array, "hanging 3"], Float[Array, "hanging 3"]],
    least: Float[Array, " hanging"],
) -> tuple[Float[Array, "hanging 3"], Float[Array, " hanging"]]:
    """How hanging vertices move so as to clear the legs.

    A leg in front of the vertex, seen along the way out of the skirt, carries it: so a
    leg that comes forward takes the front of the skirt along instead of poking through
    it. Beside a leg, the vertex keeps off the nearest skin. The two blend.

    Args:
        meeting: Where it may meet the legs.
        outward: The way out of the skirt in this pose, unit.
        near: `skin_foot` of its vertices.
        front: `skin_foot` of the places on their way out.
        least: Wanted height above the skin [m].

    Returns:
        Displacements [m] and heights above the nearest skin [m].
    """
    points, cost = meeting.points[0], meeting.cost
    foot, up = near
    height = jnp.sum((points - foot) * up, axis=1)
    short = jnp.maximum(least - height, 0.0)[:, None] * up
    foot, normal = front
    slope = jnp.maximum(jnp.sum(normal * outward, axis=1), _FACING)
    way = (jnp.sum((foot - points) * normal, axis=1) + least) / slope
    share = jnp.clip((_MISS - cost) / (_MISS - _HIT), 0.0, 1.0)
    share = (share * share * (3 - 2 * share))[:, None]
    long = jnp.clip(way, 0.0, _FARTHEST)[:, None] * outward
    return short + share * (long - short), height


def skin_foot(
    skin: Float[Array, "skin 3"],
    normals: Float[Array, "skin 3"],
    faces: Int[Array, "faces 3"],
    points: Float[Array, "points 3"],
    candidates: Int[Array, "points k"],
) -> tuple[Float[Array, "points 3"], Float[Array, "points 3"]]:
    """The nearest points of the skin [m] and its smooth unit normals there.

    Args:
        skin: Skin vertices in this pose [m].
        normals: Their normals.
        faces: Triangles over them.
        points: Where from [m].
        candidates: Triangles compared for each.
    """
    hit = closest_among(TriMesh(skin, faces), points, candidates)
    tri = faces[hit.face]
    foot = jnp.einsum("pk,pkx->px", hit.weights, skin[tri], precision=jax.lax.Precision.HIGHEST)
    return foot, safe_normalize(
        jnp.einsum("pk,pkx->px", hit.weights, normals[tri], precision=jax.lax.Precision.HIGHEST)
    )


def _least(
    cost: Float[Array, "hanging patches"], among: Bool[Array, "hanging patches"]
) -> Int[Array, " hanging"]:
    return least_index(jnp.where(among, cost, _NOWHERE))
