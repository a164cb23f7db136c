"""Binding meshes to maps by ray casting: T_BC, T_XB and sampling weights."""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.spatial import KDTree

from ..body import NUM_BODY_VERTICES, Body
from ..garment import Garment, Template
from ..geometry import TriMesh, cast_rays, closest_points, padded_rows, vertex_normals
from ..typing import pytree
from ._atlas import Atlas
from ._dress_body import dress_body
from ._transference import Transference

# Cloth farther from the skin than this isn't what a texel's ray was meant to meet [m].
_REACH: dict[Template, float] = {"top": 0.08, "bottom": 0.08, "dress": 0.30}
# A ray hit this much farther than the closest point has met another limb.
_STRAY = 2.0


@pytree
@dataclasses.dataclass(frozen=True)
class Binding:
    """A garment tied to an atlas.

    Attributes:
        to_body: T_XB, body vertices to garment vertices.
        texel: Texels (rows of the atlas) each vertex samples, shape [vertices, 4].
        weight: Their weights, rows sum to 1, shape [vertices, 4].
        hit_rate: Share of vertices whose ray met the body where it is nearest, no other limb.
        fallbacks: Vertices bound by the closest point instead.
        off_chart: Vertices whose texels were all uncovered, bound to the nearest one.
    """

    to_body: Transference
    texel: Int[Array, "vertices 4"]
    weight: Float[Array, "vertices 4"]
    # No part of a program's identity: garments of other sizes share it.
    hit_rate: Float[Array, ""]
    fallbacks: Int[Array, ""]
    off_chart: Int[Array, ""]

    def sample(
        self, values: Float[Array, "*batch texels channels"]
    ) -> Float[Array, "*batch vertices channels"]:
        """Texel values carried to garment vertices, bilinearly, within the chart."""
        out = jnp.zeros((), values.dtype)
        for k in range(4):
            w = self.weight[:, k]
            w = w.reshape((1,) * (values.ndim - 2) + (*w.shape, 1))
            out = out + values[..., self.texel[:, k], :] * w
        return out


def chart_mesh(
    atlas: Atlas, body: Body, rest: Float[Array, "all 3"], template: Template
) -> TriMesh:
    """The clothed part of the body at rest; with joined legs for a dress."""
    vertices = dress_body(body, np.asarray(rest)) if template == "dress" else rest
    full = jnp.asarray(np.asarray(vertices, dtype=np.float32))
    return TriMesh(full[:NUM_BODY_VERTICES], atlas.faces, atlas.uv, atlas.uv_faces)


def garment_map_rows(
    atlas: Atlas, body: Body, rest: Float[Array, "all 3"], garment: Garment
) -> Transference:
    """T_BC: for each texel, the cloth point that the ray along its normal meets.

    Args:
        atlas: The atlas.
        body: The body.
        rest: Its rest vertices [m].
        garment: The garment on it.

    Returns:
        Garment vertices to texels; ``valid`` where the ray met cloth within reach.

    Note (differs from the paper):
        Cast in the rest pose (arms 45 degrees down), in which garments are modelled,
        not in a T-pose.

    References:
        PhysXNet, equation 8.
    """
    mesh = chart_mesh(atlas, body, rest, garment.template)
    closed = mesh.replace(faces=_all_faces(body))
    normals = atlas.to_body @ vertex_normals(closed.vertices, closed.faces)
    points = atlas.to_body @ mesh.vertices
    # From just below the skin, so that cloth lying on it is met too.
    start = 0.005
    hits = cast_rays(
        garment.mesh,
        points - start * normals,
        normals,
        max_distance=_REACH[garment.template] + start,
    )
    return Transference(garment.mesh.faces[hits.face], hits.weights, hits.valid)


def bind(
    atlas: Atlas,
    body: Body,
    rest: Float[Array, "all 3"],
    garment: Garment,
    valid: Bool[Array, " texels"],
) -> Binding:
    """Ties a garment to the texels of its template, once.

    Each vertex casts a ray along its normal, both ways, and takes the nearest hit;
    where none is met, or one that lies on another limb, the closest point. The texel
    found there is sampled bilinearly among texels of its own neighbourhood that the
    template covers, so nothing bleeds over the chart's edge.

    Args:
        atlas: The atlas.
        body: The body.
        rest: Its rest vertices [m].
        garment: Any garment on it.
        valid: Texels that the template covers.

    Returns:
        The binding, with counts of what had to fall back.

    References:
        PhysXNet, equation 9: T_XB.
    """
    mesh = chart_mesh(atlas, body, rest, garment.template)
    normals = vertex_normals(garment.mesh.vertices, garment.mesh.faces)
    count = len(normals)
    points, normals = (
        jnp.asarray(padded_rows(np.asarray(x))) for x in (garment.mesh.vertices, normals)
    )
    hits = cast_rays(mesh, points, normals, both=True, max_distance=_REACH[garment.template])
    near = closest_points(mesh, points)
    # On the host from here: nothing to compile.
    reach = np.where(np.asarray(hits.valid), np.abs(np.asarray(hits.distance)), np.inf)
    good = reach <= _STRAY * np.sqrt(np.asarray(near.squared_distance)) + 0.01
    face = np.where(good, np.asarray(hits.face), np.asarray(near.face))
    weights = np.where(good[:, None], np.asarray(hits.weights), np.asarray(near.weights))
    good, face, weights = good[:count], face[:count], weights[:count]
    uv = np.einsum("vk,vkc->vc", weights, np.asarray(mesh.uv)[np.asarray(mesh.uv_faces)[face]])
    texel, weight, off = sampling_weights(atlas, uv, np.asarray(valid), mesh, face, weights)
    return Binding(
        Transference(
            jnp.asarray(np.asarray(mesh.faces)[face]),
            jnp.asarray(weights),
            jnp.asarray(np.ones(face.shape, bool)),
        ),
        jnp.asarray(texel),
        jnp.asarray(weight),
        jnp.asarray(np.float32(np.mean(good))),
        jnp.asarray(np.int32(np.sum(~good))),
        jnp.asarray(np.int32(off)),
    )


def sampling_weights(
    atlas: Atlas,
    uv: Float[np.ndarray, "points 2"],
    valid: Bool[np.ndarray, " texels"],
    mesh: TriMesh,
    face: Int[np.ndarray, " points"],
    weights: Float[np.ndarray, "points 3"],
) -> tuple[Int[np.ndarray, "points 4"], Float[np.ndarray, "points 4"], int]:
    """Bilinear weights over valid texels that are neighbours on the body as well.

    Texels next to each other on the map may lie on different limbs: those farther than
    a few texels' width from the point, measured on the body, don't count. A point
    without any takes the texel nearest to it on the body.

    Returns:
        Rows of the atlas, weights that sum to 1, and how many points had none.
    """
    row_of = np.full(atlas.height * atlas.width, -1)
    row_of[np.asarray(atlas.texels)] = np.arange(atlas.num_texels)
    x = uv[:, 0] * atlas.width - 0.5
    y = (1.0 - uv[:, 1]) * atlas.height - 0.5
    x0, y0 = np.floor(x).astype(int), np.floor(y).astype(int)
    fx, fy = x - x0, y - y0
    places = np.asarray(atlas.to_body @ mesh.vertices)
    here = np.einsum("vk,vkc->vc", weights, np.asarray(mesh.vertices)[np.asarray(mesh.faces)[face]])
    texel = np.zeros((len(uv), 4), dtype=np.int32)
    weight = np.zeros((len(uv), 4))
    # One texel covers about 1.5 m / size of skin; seams are much farther apart.
    limit = 6.0 / min(atlas.height, atlas.width)
    for k, (dx, dy) in enumerate(((0, 0), (1, 0), (0, 1), (1, 1))):
        cx, cy = x0 + dx, y0 + dy
        inside = (cx >= 0) & (cx < atlas.width) & (cy >= 0) & (cy < atlas.height)
        row = np.where(
            inside,
            row_of[
                np.clip(cy, 0, atlas.height - 1) * atlas.width + np.clip(cx, 0, atlas.width - 1)
            ],
            -1,
        )
        ok = (row >= 0) & valid[row]
        ok &= np.linalg.norm(places[row] - here, axis=1) < limit
        w = np.where(dx, fx, 1 - fx) * np.where(dy, fy, 1 - fy)
        texel[:, k] = np.where(ok, row, 0)
        weight[:, k] = np.where(ok, w, 0.0)
    total = weight.sum(axis=1)
    lost = total < 1e-3
    if lost.any():
        rows = np.flatnonzero(valid)
        nearest = rows[KDTree(places[rows]).query(here[lost])[1]]
        texel[lost] = nearest[:, None]
        weight[lost] = [1.0, 0.0, 0.0, 0.0]
        total = np.where(lost, 1.0, total)
    weight /= total[:, None]
    return texel, weight.astype(np.float32), int(lost.sum())


def _all_faces(body: Body) -> Array:
    return body.rest_mesh().faces
