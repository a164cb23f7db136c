"""The last touch: vertices that a prediction left inside the body move onto it."""

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.spatial import KDTree

from ..body import NUM_BODY_VERTICES, Body, blend_rotations
from ..geometry import (
    Stencil,
    TriMesh,
    gaussian_stencil,
    least_index,
    mesh_edges,
    safe_normalize,
    spread_points,
    vertex_normals,
)
from ..models import Wearable, skin_points
from ..typing import pytree
from ._skirt import SkirtPatch, make_skirt_patch, skin_foot, skirt_lift, skirt_meeting

# Places on the skin compared for each vertex, their distance [m], and the triangles around
# the nearest of them: folds of the body bring skin near that isn't at rest.
_CHOICES, _SPACING, _PATCH = 24, 0.025, 20
# Least height of cloth above the skin; of a top above trousers; most of those beneath it [m].
_GAP, _ABOVE, _BENEATH = 0.005, 0.011, 0.006
# Tops are over trousers that are this near at rest, and no longer from here on [m].
_ON, _OVER = 0.04, 0.08
# Long edges cut corners off a limb of this radius; vertices rise by as much, within reason [m].
_LIMB, _RISE = 0.05, 0.015
# Nothing is lifted from deeper than this [m].
_DEEPEST = 0.04
# What a leg lifts carries the cloth around it along, over about this distance [m].
_CARRY = 0.05


@pytree
@dataclasses.dataclass(frozen=True)
class SkinPatch:
    """The skin near each garment vertex.

    Attributes:
        used: Body vertices that are near, shape [skin].
        rest: Those at rest [m], shape [skin, 3].
        normals: Their unit normals at rest, shape [skin, 3].
        weights: Their skinning weights, shape [skin, joints].
        faces: Triangles over them, shape [faces, 3].
        places: Those of them that are compared first, shape [places].
        choices: Places near each vertex that lies on the skin, the nearest at rest first,
            shape [lying, c].
        table: Triangles around each place, shape [places, k].
        least: Least height above the skin [m], shape [vertices].
        most: Greatest height, for what is worn beneath something [m], shape [vertices].
        skirt: Skin that hanging cloth may meet; None for what lies on the skin.
        carry: How a lifted part of a skirt carries its neighbourhood along; likewise.
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
    skirt: SkirtPatch | None
    carry: Stencil | None


def make_patch(
    body: Body, rest: Float[Array, "all 3"], wearable: Wearable, garment: TriMesh
) -> SkinPatch:
    """Triangles round the skin that each vertex is near at rest, or may come near.

    Which they are, and how far a vertex stands off, is told on the default shape, where
    garments are modelled; other shapes carry it along.

    Args:
        body: The body.
        rest: Its rest vertices [m].
        wearable: The garment on it.
        garment: The garment's mesh on the default shape, whose edges decide how far it
            stands off.
    """
    mesh = body.mesh(rest[:NUM_BODY_VERTICES])
    faces = np.asarray(mesh.faces)
    modelled = body.rest_vertices(body.default_shape())
    points = np.asarray(garment.vertices)
    vertices = np.asarray(modelled)[:NUM_BODY_VERTICES]
    lying = points
    skirt = carry = None
    if wearable.template == "dress":
        carry = gaussian_stencil(points, np.asarray(garment.faces), _CARRY)
        skirt = make_skirt_patch(body, modelled, wearable, faces, garment, carry)
        lying = points[np.asarray(skirt.lying)]
    places, choices = _places_near(vertices, lying)
    table = KDTree(vertices[faces].mean(axis=1)).query(vertices[places], k=_PATCH)[1]
    table = table.reshape(-1, _PATCH)
    taken = table.ravel()
    if skirt is not None:
        taken = np.concatenate([taken, np.asarray(skirt.table).ravel()])
    used, local = np.unique(taken, return_inverse=True)
    rows, corners = np.unique(faces[used], return_inverse=True)
    pick = jnp.asarray(rows.astype(np.int32))
    # In terms of the vertices and triangles that are kept.
    if skirt is not None:
        middle = np.searchsorted(rows, np.asarray(skirt.middles)).astype(np.int32)
        around = local[table.size :].reshape(skirt.table.shape).astype(np.int32)
        skirt = dataclasses.replace(skirt, middles=jnp.asarray(middle), table=jnp.asarray(around))
    return SkinPatch(
        pick,
        mesh.vertices[pick],
        vertex_normals(mesh.vertices, mesh.faces)[pick],
        body.weights[pick],
        jnp.asarray(corners.reshape(-1, 3).astype(np.int32)),
        jnp.asarray(np.searchsorted(rows, places).astype(np.int32)),
        jnp.asarray(choices.astype(np.int32)),
        jnp.asarray(local[: table.size].reshape(table.shape).astype(np.int32)),
        jnp.asarray(least_height(points, np.asarray(garment.faces))),
        jnp.full((len(points),), jnp.inf, jnp.float32),
        skirt,
        carry,
    )


def _places_near(
    skin: Float[np.ndarray, "body 3"], points: Float[np.ndarray, "lying 3"]
) -> tuple[Int[np.ndarray, " places"], Int[np.ndarray, "lying c"]]:
    """Vertices all over the skin, and which of them each point is near."""
    spread = spread_points(skin, _SPACING)
    count = min(_CHOICES, len(spread))
    near = KDTree(skin[spread]).query(points, k=count)[1].reshape(-1, count)
    kept, choices = np.unique(near, return_inverse=True)
    return spread[kept], choices.reshape(near.shape)


def faces_at_rest(patch: SkinPatch) -> Int[Array, "lying k"]:
    """Triangles around the place that each lying vertex is nearest to at rest."""
    return patch.table[patch.choices[:, 0]]


def faces_near(
    patch: SkinPatch, skin: Float[Array, "skin 3"], points: Float[Array, "lying 3"]
) -> Int[Array, "lying k"]:
    """Triangles around the nearest place of each lying vertex, in a pose.

    Args:
        patch: The skin near each vertex.
        skin: Where it is [m].
        points: Lying vertices [m].
    """
    # Number by number, points last, as CPUs like it; which place it is needs no derivative.
    places, p = jax.lax.stop_gradient((skin[patch.places].T, points.T))
    order = patch.choices.T
    squared = jnp.sum(jnp.stack([q[None] - s[order] for q, s in zip(p, places)]) ** 2, axis=0)
    near = least_index(squared, axis=0)
    return patch.table[patch.choices[jnp.arange(near.shape[0]), near]]


def least_height(
    points: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> Float[np.ndarray, " vertices"]:
    """Heights at which straight edges stay out of round limbs [m]."""
    edges = mesh_edges(faces).vertices
    length = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1)
    longest = np.zeros(len(points))
    for k in range(2):
        np.maximum.at(longest, edges[:, k], length)
    rise = np.minimum(longest**2 / (8 * _LIMB), _RISE)
    return (_GAP + rise).astype(np.float32)


def tuck_in(patches: Sequence[SkinPatch], wearables: Sequence[Wearable]) -> tuple[SkinPatch, ...]:
    """Patches for garments worn together: trousers go beneath a top.

    Where a top covers them at rest, trousers keep near the skin and the top keeps off it.
    Elsewhere nothing changes, and a garment worn alone isn't touched.

    Args:
        patches: Of what is worn.
        wearables: What is worn, in the same order.
    """
    tops = [w for w in wearables if w.template == "top"]
    if not tops or all(w.template != "bottom" for w in wearables):
        return tuple(patches)
    hem = min(float(w.rest[:, 1].min()) for w in tops)
    pairs = list(zip(patches, wearables, strict=True))
    beneath = [jnp.maximum(p.least, _BENEATH) for p, w in pairs if w.template == "bottom"]
    above = float(max(b.max() for b in beneath)) + _ABOVE - _BENEATH
    waist = KDTree(
        np.concatenate([np.asarray(w.rest) for w in wearables if w.template == "bottom"])
    )
    out = []
    for patch, w in pairs:
        below = jnp.maximum(hem - w.rest[:, 1], 0.0)
        if w.template == "bottom":
            # Released over a few centimetres below the hem, so that no step shows.
            patch = dataclasses.replace(
                patch, most=jnp.maximum(patch.least, _BENEATH) + 2.0 * below
            )
        elif w.template == "top":
            # Released again where no trousers are beneath.
            away = waist.query(np.asarray(w.rest))[0]
            share = jnp.asarray(np.clip((_OVER - away) / (_OVER - _ON), 0, 1), jnp.float32)
            more = jnp.maximum(above - patch.least, 0.0)
            patch = dataclasses.replace(patch, least=patch.least + share * more)
        out.append(patch)
    return tuple(out)


def skin_height(
    patch: SkinPatch,
    points: Float[Array, "vertices 3"],
    rotations: Float[Array, "joints 3 3"],
    translations: Float[Array, "joints 3"],
) -> tuple[Float[Array, " vertices"], Float[Array, "vertices 3"]]:
    """Height of points above the nearby skin [m] and how they move to clear it [m].

    Hanging cloth is measured against legs, hips and belly, other cloth against the skin
    that was within several centimetres of it at rest.

    Args:
        patch: The skin near each point.
        points: Garment vertices [m].
        rotations: World rotations of joints.
        translations: World translations of joints [m].
    """
    posed = _posed(patch, rotations, translations)
    return _clearance(patch, points, posed, rotations, None)


def _posed(patch: SkinPatch, rotations: Array, translations: Array) -> tuple[Array, Array]:
    """Skin and its normals, shape [skin, 3] each."""
    skin, blend = skin_points(patch.rest, patch.weights, rotations, translations)
    return skin, jnp.einsum("vab,vb->va", blend, patch.normals, precision=jax.lax.Precision.HIGHEST)


def _clearance(
    patch: SkinPatch,
    points: Array,
    posed: tuple[Array, Array],
    rotations: Array,
    candidates: Array | None,
) -> tuple[Float[Array, " vertices"], Float[Array, "vertices 3"]]:
    skin, normals = posed
    on = points if patch.skirt is None else points[patch.skirt.lying]
    candidates = faces_near(patch, skin, on) if candidates is None else candidates
    if patch.skirt is None:
        feet = skin_foot(skin, normals, patch.faces, points, candidates)
        return _off_skin(points, feet, patch.least, patch.most)
    lying, rows = patch.skirt.lying, patch.skirt.rows
    turn = blend_rotations(patch.skirt.weights, rotations)
    outward = safe_normalize(
        jnp.einsum("hab,hb->ha", turn, patch.skirt.outward, precision=jax.lax.Precision.HIGHEST)
    )
    meeting = skirt_meeting(patch.skirt, points[rows], outward, skin, normals)
    # One search for all: three would be three times the program to compile.
    feet = skin_foot(
        skin,
        normals,
        patch.faces,
        jnp.concatenate([on, *meeting.points]),
        jnp.concatenate([candidates, *meeting.candidates]),
    )
    ends = np.cumsum([len(lying), len(rows), len(rows)])
    on_skin, near, front = zip(*(jnp.split(x, ends[:-1]) for x in feet), strict=True)
    low, lift = _off_skin(on, on_skin, patch.least[lying], patch.most[lying])
    lifted, above = skirt_lift(meeting, outward, near, front, patch.least[rows])
    order = patch.skirt.order
    return jnp.concatenate([low, above])[order], jnp.concatenate([lift, lifted])[order]


def _off_skin(
    points: Float[Array, "lying 3"],
    feet: tuple[Float[Array, "lying 3"], Float[Array, "lying 3"]],
    least: Float[Array, " lying"],
    most: Float[Array, " lying"],
) -> tuple[Float[Array, " lying"], Float[Array, "lying 3"]]:
    foot, normal = feet
    height = jnp.sum((points - foot) * normal, axis=1)
    # Deeper points are on another limb's far side, not in the skin.
    fade = jnp.clip((height + _DEEPEST) / (0.25 * _DEEPEST), 0.0, 1.0)
    lift = fade * jnp.maximum(least - height, 0.0) - jnp.maximum(height - most, 0.0)
    return height, lift[:, None] * normal


def push_out(
    patch: SkinPatch,
    points: Float[Array, "vertices 3"],
    rotations: Float[Array, "joints 3 3"],
    translations: Float[Array, "joints 3"],
) -> Float[Array, "vertices 3"]:
    """Points moved to the least and greatest height of their patch.

    Continuous while the nearest place on the skin doesn't change. Cloth on the skin moves
    along the skin's normal; vertices deeper than four centimetres are left alone, in
    the last centimetre before it the lift fades out. Hanging cloth is carried by the
    legs, see `skirt_lift`: once smoothly, then exactly.

    Args:
        patch: The skin near each point.
        points: Garment vertices [m].
        rotations: World rotations of joints.
        translations: World translations of joints [m].
    """
    return _cleared(patch, points, _posed(patch, rotations, translations), rotations, None)


def push_out_of(
    patch: SkinPatch,
    points: Float[Array, "vertices 3"],
    rotations: Float[Array, "joints 3 3"],
    skin: Float[Array, "skin 3"],
    candidates: Int[Array, "lying k"],
) -> Float[Array, "vertices 3"]:
    """The same as `push_out` for skin that isn't where skinning puts it.

    Args:
        patch: The skin near each point at rest.
        points: Garment vertices [m].
        rotations: World rotations of joints.
        skin: Where the patch's skin is [m].
        candidates: Its triangles near each vertex there.
    """
    posed = skin, vertex_normals(skin, patch.faces)
    return _cleared(patch, points, posed, rotations, candidates)


def _cleared(
    patch: SkinPatch,
    points: Array,
    posed: tuple[Array, Array],
    rotations: Array,
    candidates: Array | None,
) -> Float[Array, "vertices 3"]:
    move = _clearance(patch, points, posed, rotations, candidates)[1]
    if patch.carry is None:
        return points + move
    points = points + patch.carry @ move
    return points + _clearance(patch, points, posed, rotations, candidates)[1]
