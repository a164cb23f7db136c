"""The last touch: vertices that a prediction left inside the body move onto it."""

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.spatial import KDTree

from ..body import NUM_BODY_VERTICES, Body
from ..geometry import TriMesh, closest_among, safe_normalize, vertex_normals
from ..models import Wearable, skin_points
from ..typing import pytree

# Triangles compared for each vertex: a patch of about five centimetres.
_PATCH = 20
# Least height of cloth above the skin; of a top above trousers; most of those beneath it [m].
_GAP, _ABOVE, _BENEATH = 0.005, 0.011, 0.006


@pytree
@dataclasses.dataclass(frozen=True)
class SkinPatch:
    """The skin near each garment vertex.

    Attributes:
        rest: Body vertices used, at rest [m], shape [skin, 3].
        normals: Their unit normals at rest, shape [skin, 3].
        weights: Their skinning weights, shape [skin, joints].
        faces: Triangles over them, shape [faces, 3].
        candidates: Triangles near each garment vertex, shape [vertices, k].
        least: Least height above the skin [m], shape [vertices].
        most: Greatest height, for what is worn beneath something [m], shape [vertices].
    """

    rest: Float[Array, "skin 3"]
    normals: Float[Array, "skin 3"]
    weights: Float[Array, "skin joints"]
    faces: Int[Array, "faces 3"]
    candidates: Int[Array, "vertices k"]
    least: Float[Array, " vertices"]
    most: Float[Array, " vertices"]


def make_patch(body: Body, rest: Float[Array, "all 3"], wearable: Wearable) -> SkinPatch:
    """Triangles round the skin point nearest to each vertex at rest."""
    mesh = body.mesh(rest[:NUM_BODY_VERTICES])
    faces = np.asarray(mesh.faces)
    middles = np.asarray(mesh.vertices)[faces].mean(axis=1)
    near = KDTree(middles).query(np.asarray(wearable.rest), k=_PATCH)[1]
    used_faces, local_faces = np.unique(near, return_inverse=True)
    rows, corners = np.unique(faces[used_faces], return_inverse=True)
    pick = jnp.asarray(rows)
    return SkinPatch(
        mesh.vertices[pick],
        vertex_normals(mesh.vertices, mesh.faces)[pick],
        body.weights[pick],
        jnp.asarray(corners.reshape(-1, 3).astype(np.int32)),
        jnp.asarray(local_faces.reshape(near.shape).astype(np.int32)),
        jnp.full((near.shape[0],), _GAP, jnp.float32),
        jnp.full((near.shape[0],), jnp.inf, jnp.float32),
    )


def tuck_in(patches: Sequence[SkinPatch], wearables: Sequence[Wearable]) -> tuple[SkinPatch, ...]:
    """Patches for garments worn together: trousers go beneath a top.

    Where a top covers them at rest, trousers keep near the skin and the top keeps off it.
    Elsewhere nothing changes, and a garment worn alone isn't touched.
    """
    tops = [w for w in wearables if w.template == "top"]
    if not tops or all(w.template != "bottom" for w in wearables):
        return tuple(patches)
    hem = min(float(w.rest[:, 1].min()) for w in tops)
    out = []
    for patch, w in zip(patches, wearables, strict=True):
        below = jnp.maximum(hem - w.rest[:, 1], 0.0)
        if w.template == "bottom":
            # Released over a few centimetres below the hem, so that no step shows.
            patch = dataclasses.replace(patch, most=_BENEATH + 2.0 * below)
        elif w.template == "top":
            patch = dataclasses.replace(patch, least=jnp.full_like(patch.least, _ABOVE))
        out.append(patch)
    return tuple(out)


def skin_height(
    patch: SkinPatch,
    points: Float[Array, "vertices 3"],
    rotations: Float[Array, "joints 3 3"],
    translations: Float[Array, "joints 3"],
) -> tuple[Float[Array, " vertices"], Float[Array, "vertices 3"]]:
    """Height of points above the nearby skin [m] and the skin's smooth normal there."""
    skin, blend = skin_points(patch.rest, patch.weights, rotations, translations)
    normals = jnp.einsum("vab,vb->va", blend, patch.normals)
    hit = closest_among(TriMesh(skin, patch.faces), points, patch.candidates)
    tri = patch.faces[jax.lax.stop_gradient(hit.face)]
    weights = hit.weights
    foot = jnp.einsum("vk,vkc->vc", weights, skin[tri])
    normal = safe_normalize(jnp.einsum("vk,vkc->vc", weights, normals[tri]))
    return jnp.sum((points - foot) * normal, axis=1), normal


def push_out(
    patch: SkinPatch,
    points: Float[Array, "vertices 3"],
    rotations: Float[Array, "joints 3 3"],
    translations: Float[Array, "joints 3"],
    *,
    deepest: float = 0.04,
) -> Float[Array, "vertices 3"]:
    """Points moved along the normal to the least and greatest height of their patch.

    Continuous in its inputs. Points deeper than ``deepest`` are on another limb's far
    side, not in the skin, and stay; in the last quarter before it the lift fades out.

    Args:
        patch: The skin near each point.
        points: Garment vertices [m].
        rotations: World rotations of joints.
        translations: World translations of joints [m].
        deepest: Depth from which on nothing is done [m].
    """
    height, normal = skin_height(patch, points, rotations, translations)
    fade = jnp.clip((height + deepest) / (0.25 * deepest), 0.0, 1.0)
    lift = fade * jnp.maximum(patch.least - height, 0.0) - jnp.maximum(height - patch.most, 0.0)
    return points + lift[:, None] * normal
