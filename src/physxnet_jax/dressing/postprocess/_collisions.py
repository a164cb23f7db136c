"""Collision resolution: moves garment vertices out of the body."""

import dataclasses
import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.spatial import KDTree

from ...body import NUM_BODY_VERTICES, Body, blend_rotations, skin_points
from ...garment import SkinnedGarment
from ...geometry import (
    Stencil,
    TriMesh,
    gaussian_stencil,
    map_frames,
    mesh_edges,
    nearest_index,
    safe_normalize,
    spread_points,
    vertex_normals,
)
from ...typing import pytree
from .._inference import Inference
from ._outfit import Cloth, Outfit
from ._skirt import (
    SkirtCollider,
    closest_skin_point,
    make_skirt_collider,
    skirt_contacts,
    skirt_correction,
)

# Skin points compared for each vertex, their spacing [m], and the triangles around the nearest
# one. There are several because folds of the body bring skin near that isn't near at rest.
_NUM_CHOICES, _SPACING, _NUM_TRIANGLES = 24, 0.025, 20
# Minimum height of cloth above the skin; of a top over trousers; maximum height of those [m].
_CLEARANCE, _TOP_CLEARANCE, _MAX_BENEATH = 0.005, 0.011, 0.006
# Distance at rest up to which a top counts as over trousers, and from which it doesn't [m].
_COVERED, _UNCOVERED = 0.04, 0.08
# Long edges cut into a limb of this radius; vertices rise to compensate, up to a limit [m].
_LIMB_RADIUS, _MAX_RISE = 0.05, 0.015
# Deeper vertices aren't moved [m].
_MAX_DEPTH = 0.04
# Cloth lifted by a leg carries its neighbourhood along over about this distance [m].
_CARRY_WIDTH = 0.05


@pytree
@dataclasses.dataclass(frozen=True)
class BodyCollider:
    """The skin near each garment vertex.

    Attributes:
        used: Indices of the nearby body vertices, shape [skin].
        rest: Their rest positions [m], shape [skin, 3].
        normals: Their unit normals at rest, shape [skin, 3].
        weights: Their skinning weights, shape [skin, joints].
        faces: Triangles of these vertices, shape [faces, 3].
        places: Sample points among them for the coarse search, shape [places].
        choices: Places near each vertex that lies on the skin, the nearest at rest first,
            shape [lying, c].
        table: Triangles around each place, shape [places, k].
        least: Minimum height above the skin [m], shape [vertices].
        most: Maximum height, for garments beneath others [m], shape [vertices].
        skirt: Skin that hanging cloth may touch; None if all cloth lies on the skin.
        carry: Smoothing by which a lifted part of a skirt carries its neighbourhood along;
            None likewise.
    """

    used: Int[Array, " skin"]
    rest: Float[Array, "skin 3"]
    normals: Float[Array, "skin 3"]
    weights: Float[Array, "skin joints"]
    faces: Int[Array, "faces 3"]
    places: Int[Array, " places"]
    choices: Int[Array, "lying c"]
    table: Int[Array, "places k"]
    least: Float[Array, " vertices"]
    most: Float[Array, " vertices"]
    skirt: SkirtCollider | None
    carry: Stencil | None


def prepare_collisions(outfit: Outfit, inference: Inference) -> tuple[BodyCollider, ...] | None:
    """Makes the colliders of all garments, with clearance for the layers beneath.

    Args:
        outfit: The garments.
        inference: Its ``collisions`` enable the step.
    """
    return make_colliders(outfit) if inference.collisions else None


def make_colliders(outfit: Outfit) -> tuple[BodyCollider, ...]:
    """`prepare_collisions` whatever was requested: for measurements of penetration."""
    pairs = zip(outfit.worn, outfit.garments, strict=True)
    colliders = [make_collider(outfit.body, outfit.rest, w, g.mesh) for w, g in pairs]
    return set_layer_clearance(colliders, outfit.worn)


def apply_collisions(
    colliders: Sequence[BodyCollider],
    cloth: Cloth,
    rotations: Float[Array, "frames joints 3 3"],
    translations: Float[Array, "frames joints 3"],
) -> Cloth:
    """Moves garments out of the body [m], frame by frame; see `resolve_collisions`."""
    return tuple(
        map_frames(functools.partial(resolve_collisions, c), x, rotations, translations)
        for c, x in zip(colliders, cloth, strict=True)
    )


def reshape_colliders(
    colliders: Sequence[BodyCollider], body: Body, rest: Float[Array, "all 3"]
) -> tuple[BodyCollider, ...]:
    """Moves colliders to another body shape; pure.

    Args:
        colliders: From `prepare_collisions`.
        body: The body.
        rest: Its rest vertices [m].
    """
    mesh = body.mesh(rest[:NUM_BODY_VERTICES])
    normals = vertex_normals(mesh.vertices, mesh.faces)
    return tuple(
        dataclasses.replace(c, rest=rest[c.used], normals=normals[c.used]) for c in colliders
    )


def make_collider(
    body: Body, rest: Float[Array, "all 3"], worn: SkinnedGarment, garment: TriMesh
) -> BodyCollider:
    """Collects the skin that each vertex is near at rest, or may come near.

    The choice of skin and the clearance of each vertex are determined on the default shape,
    where garments are modelled, and kept on other shapes.

    Args:
        body: The body.
        rest: Its rest vertices [m].
        worn: The garment on it.
        garment: The garment's mesh on the default shape, whose edges determine the clearance.
    """
    mesh = body.mesh(rest[:NUM_BODY_VERTICES])
    faces = np.asarray(mesh.faces)
    modelled = body.rest_vertices(body.default_shape())
    points = np.asarray(garment.vertices)
    vertices = np.asarray(modelled)[:NUM_BODY_VERTICES]
    lying = points
    skirt = carry = None
    if worn.template == "dress":
        carry = gaussian_stencil(points, np.asarray(garment.faces), _CARRY_WIDTH)
        skirt = make_skirt_collider(body, modelled, worn, faces, garment, carry)
        lying = points[np.asarray(skirt.lying)]
    places, choices = _sample_places(vertices, lying)
    table = KDTree(vertices[faces].mean(axis=1)).query(vertices[places], k=_NUM_TRIANGLES)[1]
    table = table.reshape(-1, _NUM_TRIANGLES)
    taken = table.ravel()
    if skirt is not None:
        taken = np.concatenate([taken, np.asarray(skirt.table).ravel()])
    used, local = np.unique(taken, return_inverse=True)
    rows, corners = np.unique(faces[used], return_inverse=True)
    pick = jax.device_put(rows.astype(np.int32))
    # Reindexed to the vertices and triangles of the collider.
    if skirt is not None:
        middle = np.searchsorted(rows, np.asarray(skirt.middles)).astype(np.int32)
        around = local[table.size :].reshape(skirt.table.shape).astype(np.int32)
        skirt = dataclasses.replace(
            skirt, middles=jax.device_put(middle), table=jax.device_put(around)
        )
    own = np.asarray(mesh.vertices)
    normals = vertex_normals(own, faces)
    return BodyCollider(
        pick,
        jax.device_put(own[rows]),
        jax.device_put(normals[rows]),
        body.weights[pick],
        jax.device_put(corners.reshape(-1, 3).astype(np.int32)),
        jax.device_put(np.searchsorted(rows, places).astype(np.int32)),
        jax.device_put(choices.astype(np.int32)),
        jax.device_put(local[: table.size].reshape(table.shape).astype(np.int32)),
        jax.device_put(minimum_clearance(points, np.asarray(garment.faces))),
        jax.device_put(np.full(len(points), np.inf, np.float32)),
        skirt,
        carry,
    )


def _sample_places(
    skin: Float[np.ndarray, "body 3"], points: Float[np.ndarray, "lying 3"]
) -> tuple[Int[np.ndarray, " places"], Int[np.ndarray, "lying c"]]:
    """Samples vertices all over the skin, and finds those near each point."""
    spread = spread_points(skin, _SPACING)
    count = min(_NUM_CHOICES, len(spread))
    near = KDTree(skin[spread]).query(points, k=count)[1].reshape(-1, count)
    kept, choices = np.unique(near, return_inverse=True)
    return spread[kept], choices.reshape(near.shape)


def faces_at_rest(collider: BodyCollider) -> Int[Array, "lying k"]:
    """Triangles around the place nearest to each lying vertex at rest."""
    return collider.table[collider.choices[:, 0]]


def faces_near(
    collider: BodyCollider, skin: Float[Array, "skin 3"], points: Float[Array, "lying 3"]
) -> Int[Array, "lying k"]:
    """Triangles around the place nearest to each lying vertex, in a pose.

    Args:
        collider: The skin near each vertex.
        skin: Positions of that skin [m].
        points: Lying vertices [m].
    """
    # Coordinate by coordinate with points last, for speed on CPUs. The choice of a place needs
    # no derivative.
    places, p = jax.lax.stop_gradient((skin[collider.places].T, points.T))
    order = collider.choices.T
    a, b, c = (q[None] - s[order] for q, s in zip(p, places, strict=True))
    near = nearest_index(a * a + b * b + c * c)
    return collider.table[jnp.take_along_axis(order, near[None], axis=0)[0]]


def minimum_clearance(
    points: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> Float[np.ndarray, " vertices"]:
    """Heights above the skin at which straight edges clear round limbs [m]."""
    edges = mesh_edges(faces).vertices
    length = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1)
    longest = np.zeros(len(points))
    for k in range(2):
        np.maximum.at(longest, edges[:, k], length)
    rise = np.minimum(longest**2 / (8 * _LIMB_RADIUS), _MAX_RISE)
    return (_CLEARANCE + rise).astype(np.float32)


def set_layer_clearance(
    body_colliders: Sequence[BodyCollider], worn: Sequence[SkinnedGarment]
) -> tuple[BodyCollider, ...]:
    """Sets the clearances of garments worn together: trousers lie beneath a top.

    Where a top covers trousers at rest, the trousers get a maximum height and the top a
    larger minimum height. Elsewhere, and for a garment worn alone, nothing changes.

    Args:
        body_colliders: The colliders of the garments.
        worn: The garments, in the same order.
    """
    tops = [w for w in worn if w.template == "top"]
    if not tops or all(w.template != "bottom" for w in worn):
        return tuple(body_colliders)
    hem = min(float(w.rest[:, 1].min()) for w in tops)
    pairs = list(zip(body_colliders, worn, strict=True))
    beneath = [jnp.maximum(p.least, _MAX_BENEATH) for p, w in pairs if w.template == "bottom"]
    above = float(max(b.max() for b in beneath)) + _TOP_CLEARANCE - _MAX_BENEATH
    trousers = KDTree(np.concatenate([np.asarray(w.rest) for w in worn if w.template == "bottom"]))
    out = []
    for collider, w in pairs:
        below = jnp.maximum(hem - w.rest[:, 1], 0.0)
        if w.template == "bottom":
            # The limit is released over a few centimetres below the hem, to avoid a visible step.
            collider = dataclasses.replace(
                collider, most=jnp.maximum(collider.least, _MAX_BENEATH) + 2.0 * below
            )
        elif w.template == "top":
            # The clearance falls off where there are no trousers beneath.
            distance = trousers.query(np.asarray(w.rest))[0]
            share = jnp.asarray(
                np.clip((_UNCOVERED - distance) / (_UNCOVERED - _COVERED), 0, 1), jnp.float32
            )
            more = jnp.maximum(above - collider.least, 0.0)
            collider = dataclasses.replace(collider, least=collider.least + share * more)
        out.append(collider)
    return tuple(out)


def skin_clearance(
    collider: BodyCollider,
    points: Float[Array, "vertices 3"],
    rotations: Float[Array, "joints 3 3"],
    translations: Float[Array, "joints 3"],
) -> tuple[Float[Array, " vertices"], Float[Array, "vertices 3"]]:
    """Computes heights above the nearby skin [m] and the displacements that clear it [m].

    Hanging cloth is measured against legs, hips and belly, other cloth against the skin
    within several centimetres of it at rest.

    Args:
        collider: The skin near each point.
        points: Garment vertices [m].
        rotations: World rotations of joints.
        translations: World translations of joints [m].
    """
    posed = _posed(collider, rotations, translations)
    return _clearance(collider, points, posed, rotations, None)


def _posed(collider: BodyCollider, rotations: Array, translations: Array) -> tuple[Array, Array]:
    """Skin in a pose [m] and its normals, shape [skin, 3] each."""
    skin, blend = skin_points(collider.rest, collider.weights, rotations, translations)
    return skin, jnp.einsum(
        "vab,vb->va", blend, collider.normals, precision=jax.lax.Precision.HIGHEST
    )


def _clearance(
    collider: BodyCollider,
    points: Array,
    posed: tuple[Array, Array],
    rotations: Array,
    candidates: Array | None,
) -> tuple[Float[Array, " vertices"], Float[Array, "vertices 3"]]:
    skin, normals = posed
    on = points if collider.skirt is None else points[collider.skirt.lying]
    candidates = faces_near(collider, skin, on) if candidates is None else candidates
    if collider.skirt is None:
        closest = closest_skin_point(skin, normals, collider.faces, points, candidates)
        return _off_skin(points, closest, collider.least, collider.most)
    lying, rows = collider.skirt.lying, collider.skirt.rows
    blended = blend_rotations(collider.skirt.weights, rotations)
    outward = safe_normalize(
        jnp.einsum(
            "hab,hb->ha", blended, collider.skirt.outward, precision=jax.lax.Precision.HIGHEST
        )
    )
    contacts = skirt_contacts(collider.skirt, points[rows], outward, skin, normals)
    # One search for all three sets of points, which compiles faster than three.
    closest = closest_skin_point(
        skin,
        normals,
        collider.faces,
        jnp.concatenate([on, *contacts.points]),
        jnp.concatenate([candidates, *contacts.candidates]),
    )
    ends = np.cumsum([len(lying), len(rows), len(rows)])
    on_skin, near, front = zip(*(jnp.split(x, ends[:-1]) for x in closest), strict=True)
    low, lift = _off_skin(on, on_skin, collider.least[lying], collider.most[lying])
    lifted, above = skirt_correction(contacts, outward, near, front, collider.least[rows])
    order = collider.skirt.order
    return jnp.concatenate([low, above])[order], jnp.concatenate([lift, lifted])[order]


def _off_skin(
    points: Float[Array, "lying 3"],
    closest: tuple[Float[Array, "lying 3"], Float[Array, "lying 3"]],
    least: Float[Array, " lying"],
    most: Float[Array, " lying"],
) -> tuple[Float[Array, " lying"], Float[Array, "lying 3"]]:
    point, normal = closest
    height = jnp.sum((points - point) * normal, axis=1)
    # Deeper points are on the far side of another limb, not inside the skin.
    fade = jnp.clip((height + _MAX_DEPTH) / (0.25 * _MAX_DEPTH), 0.0, 1.0)
    lift = fade * jnp.maximum(least - height, 0.0) - jnp.maximum(height - most, 0.0)
    return height, lift[:, None] * normal


def resolve_collisions(
    collider: BodyCollider,
    points: Float[Array, "vertices 3"],
    rotations: Float[Array, "joints 3 3"],
    translations: Float[Array, "joints 3"],
) -> Float[Array, "vertices 3"]:
    """Moves points between the minimum and maximum heights of their collider.

    The result is continuous while the nearest place on the skin doesn't change. Cloth on the
    skin moves along the skin's normal. Vertices deeper than four centimetres aren't moved;
    the displacement fades out over the last centimetre before that depth. Hanging cloth is
    carried by the legs (`skirt_correction`), in a smoothed step and then an exact one.

    Args:
        collider: The skin near each point.
        points: Garment vertices [m].
        rotations: World rotations of joints.
        translations: World translations of joints [m].
    """
    return _resolve(collider, points, _posed(collider, rotations, translations), rotations, None)


def resolve_collisions_with_skin(
    collider: BodyCollider,
    points: Float[Array, "vertices 3"],
    rotations: Float[Array, "joints 3 3"],
    skin: Float[Array, "skin 3"],
    candidates: Int[Array, "lying k"],
) -> Float[Array, "vertices 3"]:
    """`resolve_collisions` with given skin positions, instead of those from skinning.

    Args:
        collider: The skin near each point at rest.
        points: Garment vertices [m].
        rotations: World rotations of joints.
        skin: Positions of the collider's skin [m].
        candidates: Triangles near each lying vertex at these positions.
    """
    posed = skin, vertex_normals(skin, collider.faces)
    return _resolve(collider, points, posed, rotations, candidates)


def _resolve(
    collider: BodyCollider,
    points: Array,
    posed: tuple[Array, Array],
    rotations: Array,
    candidates: Array | None,
) -> Float[Array, "vertices 3"]:
    move = _clearance(collider, points, posed, rotations, candidates)[1]
    if collider.carry is None:
        return points + move
    points = points + collider.carry @ move
    return points + _clearance(collider, points, posed, rotations, candidates)[1]
