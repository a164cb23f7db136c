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
    mesh_edges,
    safe_normalize,
    vertex_normals,
)
from ..models import Wearable, skin_points
from ..typing import pytree
from ._skirt import SkirtPatch, make_skirt_patch, skin_foot, skirt_lift, skirt_meeting

# Triangles compared for each vertex: a patch of about five centimetres.
_PATCH = 20
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
        candidates: Triangles near each vertex that lies on the skin, shape [lying, k].
        least: Least height above the skin [m], shape [vertices].
        most: Greatest height, for what is worn beneath something [m], shape [vertices].
        skirt: Legs that hanging cloth may meet; None for what lies on the skin.
        carry: How a lifted part of a skirt carries its neighbourhood along; likewise.
    """

    used: Int[Array, " skin"]
    rest: Float[Array, "skin 3"]
    normals: Float[Array, "skin 3"]
    weights: Float[Array, "skin joints"]
    faces: Int[Array, "faces 3"]
    candidates: Int[Array, "lying k"]
    least: Float[Array, " vertices"]
    most: Float[Array, " vertices"]
    skirt: SkirtPatch | None
    carry: Stencil | None


def make_patch(
    body: Body, rest: Float[Array, "all 3"], wearable: Wearable, garment: TriMesh
) -> SkinPatch:
    """Triangles round the skin point nearest to each vertex at rest.

    Args:
        body: The body.
        rest: Its rest vertices [m].
        wearable: The garment on it.
        garment: The garment's mesh, whose edges decide how far it stands off.
    """
    mesh = body.mesh(rest[:NUM_BODY_VERTICES])
    faces = np.asarray(mesh.faces)
    points = np.asarray(wearable.rest)
    middles = np.asarray(mesh.vertices)[faces].mean(axis=1)
    lying = points
    skirt = carry = None
    if wearable.template == "dress":
        carry = gaussian_stencil(points, np.asarray(garment.faces), _CARRY)
        skirt = make_skirt_patch(body, rest, wearable, faces, garment, carry)
        lying = points[np.asarray(skirt.lying)]
    near = KDTree(middles).query(lying, k=_PATCH)[1].reshape(-1, _PATCH)
    taken = near.ravel()
    if skirt is not None:
        taken = np.concatenate([taken, np.asarray(skirt.table).ravel()])
    used, local = np.unique(taken, return_inverse=True)
    rows, corners = np.unique(faces[used], return_inverse=True)
    pick = jnp.asarray(rows.astype(np.int32))
    if skirt is not None:
        # In terms of the vertices and triangles that are kept.
        middle = np.searchsorted(rows, np.asarray(skirt.middles)).astype(np.int32)
        table = local[near.size :].reshape(skirt.table.shape).astype(np.int32)
        skirt = dataclasses.replace(skirt, middles=jnp.asarray(middle), table=jnp.asarray(table))
    return SkinPatch(
        pick,
        mesh.vertices[pick],
        vertex_normals(mesh.vertices, mesh.faces)[pick],
        body.weights[pick],
        jnp.asarray(corners.reshape(-1, 3).astype(np.int32)),
        jnp.asarray(local[: near.size].reshape(near.shape).astype(np.int32)),
        jnp.asarray(least_height(points, np.asarray(garment.faces))),
        jnp.full((len(points),), jnp.inf, jnp.float32),
        skirt,
        carry,
    )


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

    Hanging cloth is measured against both legs, other cloth against the skin it lay
    on at rest.

    Args:
        patch: The skin near each point.
        points: Garment vertices [m].
        rotations: World rotations of joints.
        translations: World translations of joints [m].
    """
    return _clearance(patch, points, _posed(patch, rotations, translations), rotations)


def _posed(patch: SkinPatch, rotations: Array, translations: Array) -> tuple[Array, Array]:
    """Skin and its normals, shape [skin, 3] each."""
    skin, blend = skin_points(patch.rest, patch.weights, rotations, translations)
    return skin, jnp.einsum("vab,vb->va", blend, patch.normals, precision=jax.lax.Precision.HIGHEST)


def _clearance(
    patch: SkinPatch, points: Array, posed: tuple[Array, Array], rotations: Array
) -> tuple[Float[Array, " vertices"], Float[Array, "vertices 3"]]:
    skin, normals = posed
    if patch.skirt is None:
        feet = skin_foot(skin, normals, patch.faces, points, patch.candidates)
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
        jnp.concatenate([points[lying], *meeting.points]),
        jnp.concatenate([patch.candidates, *meeting.candidates]),
    )
    ends = np.cumsum([len(lying), len(rows), len(rows)])
    on_skin, near, front = zip(*(jnp.split(x, ends[:-1]) for x in feet), strict=True)
    low, lift = _off_skin(points[lying], on_skin, patch.least[lying], patch.most[lying])
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

    Continuous while the nearest patch of skin doesn't change. Cloth on the skin moves
    along the skin's normal; vertices deeper than four centimetres are left alone, in
    the last centimetre before it the lift fades out. Hanging cloth is carried by the
    legs, see `skirt_lift`: once smoothly, then exactly.

    Args:
        patch: The skin near each point.
        points: Garment vertices [m].
        rotations: World rotations of joints.
        translations: World translations of joints [m].
    """
    return _cleared(patch, points, _posed(patch, rotations, translations), rotations)


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
    near = dataclasses.replace(patch, candidates=candidates)
    return _cleared(near, points, (skin, vertex_normals(skin, patch.faces)), rotations)


def _cleared(
    patch: SkinPatch, points: Array, posed: tuple[Array, Array], rotations: Array
) -> Float[Array, "vertices 3"]:
    move = _clearance(patch, points, posed, rotations)[1]
    if patch.carry is None:
        return points + move
    points = points + patch.carry @ move
    return points + _clearance(patch, points, posed, rotations)[1]
