"""Binding meshes to maps by ray casting: T_BC, T_XB and sampling weights."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.spatial import KDTree

from ..body import NUM_BODY_VERTICES, Body, load_body
from ..garment import Garment, Template, template
from ..geometry import (
    ROW_MULTIPLE,
    TriMesh,
    cast_rays,
    cast_rays_within,
    closest_on_host,
    nearby_faces,
    padded_rows,
    vertex_normals,
)
from ..typing import pytree
from ._atlas import Atlas, make_atlas
from ._dress_body import dress_body
from ._skirt import Hull, arm_weights, skirt_hull, skirt_rows, skirt_samples
from ._transference import Transference

# Maximum distance between skin and cloth along a ray [m].
_MAX_DISTANCE: dict[Template, float] = {"top": 0.08, "bottom": 0.08, "dress": 0.30}
# A ray hit more than this many times as far as the closest point lies on another limb.
_MAX_DISTANCE_RATIO = 2.0

# Above this number of vertices, rays are cast block by block.
_MANY = 8192


@pytree
@dataclasses.dataclass(frozen=True)
class Binding:
    """A garment bound to an atlas.

    Attributes:
        to_body: T_XB, body vertices to garment vertices.
        texel: Texels (rows of the atlas) each vertex samples, shape [vertices, k]: four, and four
            more of the skirt's chart for a dress.
        weight: Their weights, rows sum to 1, shape [vertices, k].
        hit_rate: Share of vertices whose ray hit the nearest part of the body.
        fallbacks: Number of vertices bound by the closest point instead.
        off_chart: Number of vertices without covered texels, bound to the nearest one.
    """

    to_body: Transference
    texel: Int[Array, "vertices k"]
    weight: Float[Array, "vertices k"]
    # Leaves rather than static fields, so that other values need no new compilation.
    hit_rate: Float[Array, ""]
    fallbacks: Int[Array, ""]
    off_chart: Int[Array, ""]

    def sample(
        self, values: Float[Array, "*batch texels channels"]
    ) -> Float[Array, "*batch vertices channels"]:
        """Interpolates texel values at garment vertices, bilinearly within the chart."""
        out = jnp.zeros((), values.dtype)
        for k in range(self.texel.shape[1]):
            w = self.weight[:, k]
            w = w.reshape((1,) * (values.ndim - 2) + (*w.shape, 1))
            out = out + values[..., self.texel[:, k], :] * w
        return out


def chart_mesh(atlas: Atlas, body: Body, rest: Float[Array, "all 3"], kind: Template) -> TriMesh:
    """The clothed part of the body at rest; with joined legs for a dress."""
    vertices = dress_body(body, np.asarray(rest)) if kind == "dress" else rest
    full = jax.device_put(np.asarray(vertices, dtype=np.float32))
    return TriMesh(full[:NUM_BODY_VERTICES], atlas.faces, atlas.uv, atlas.uv_faces)


def garment_map_rows(
    atlas: Atlas, body: Body, rest: Float[Array, "all 3"], garment: Garment
) -> Transference:
    """T_BC: for each texel, the cloth point that the ray along its normal hits.

    Args:
        atlas: The atlas.
        body: The body.
        rest: Its rest vertices [m].
        garment: The garment on it.

    Returns:
        Garment vertices to texels; ``valid`` where the ray hit cloth within reach.

    Note (differs from the paper):
        Rays are cast in the rest pose (arms 45 degrees down), in which garments are
        modelled, not in a T-pose.

    References:
        PhysXNet, equation 8.
    """
    mesh = chart_mesh(atlas, body, rest, garment.template)
    closed = mesh.replace(faces=_all_faces(body))
    normals = atlas.to_body @ vertex_normals(closed.vertices, closed.faces)
    points = atlas.to_body @ mesh.vertices
    # Rays start just below the skin, so that they also hit cloth lying on it.
    start = 0.005
    hits = cast_rays(
        garment.mesh,
        points - start * normals,
        normals,
        max_distance=_MAX_DISTANCE[garment.template] + start,
    )
    faces = garment.mesh.faces[hits.face]
    own = Transference(faces, hits.weights, hits.valid, garment.num_vertices)
    if atlas.skirt is None:
        return own
    if garment.template != "dress":
        below = atlas.num_texels - atlas.num_body_texels
        corners, zeros = jnp.zeros((below, 3), jnp.int32), jnp.zeros((below, 3), jnp.float32)
        return _stacked(own, Transference(corners, zeros, jnp.zeros(below, bool), own.columns))
    hull = skirt_hull(body, np.asarray(rest))
    arms = arm_weights(body, np.asarray(atlas.to_body @ body.weights))
    upper = hull.share(np.asarray(points)[:, 1], arms) < 1.0
    own = dataclasses.replace(own, valid=own.valid & jax.device_put(upper))
    return _stacked(own, skirt_rows(atlas.skirt, hull, garment, _skirt_share(body, hull, garment)))


def _stacked(a: Transference, b: Transference) -> Transference:
    return Transference(
        jnp.concatenate([a.vertices, b.vertices]),
        jnp.concatenate([a.weights, b.weights]),
        jnp.concatenate([a.valid, b.valid]),
        a.columns,
    )


def _skirt_share(body: Body, hull: Hull, garment: Garment) -> Float[np.ndarray, " vertices"]:
    heights = np.asarray(garment.mesh.vertices)[:, 1]
    return hull.share(heights, arm_weights(body, np.asarray(garment.skin)))


def bind(
    garment: Garment,
    *,
    atlas: Atlas | None = None,
    body: Body | None = None,
    rest: Float[Array, "all 3"] | None = None,
    valid: Bool[Array, " texels"] | None = None,
) -> Binding:
    """Binds a garment to the texels of its template, once.

    Each vertex casts a ray along its normal, in both directions, and takes the nearest
    hit. Without a hit, or with one on another limb, it takes the closest point. Sampling
    there is bilinear among texels that the template covers and that are neighbours on
    the body, so nothing bleeds over the chart's edge.

    Where an atlas has a chart for skirts, the lower part of a dress samples that: its rays start at
    the axis of the hull around both legs.

    Args:
        garment: Any garment on the body.
        atlas: The atlas; `make_atlas` of the body by default.
        body: The body; the built-in one by default.
        rest: Its rest vertices [m]; the default shape by default.
        valid: Texels that the template covers; found by rays to the template by default.

    Returns:
        The binding, with counts of its fallbacks.

    References:
        PhysXNet, equation 9: T_XB.
    """
    body = load_body() if body is None else body
    rest = body.rest_vertices(body.default_shape()) if rest is None else rest
    atlas = make_atlas(body=body) if atlas is None else atlas
    if valid is None:
        valid = garment_map_rows(atlas, body, rest, template(garment.template)).valid
    mesh = chart_mesh(atlas, body, rest, garment.template)
    good, face, weights = _hits(mesh, garment, np.arange(garment.num_vertices))
    uv = np.einsum("vk,vkc->vc", weights, np.asarray(mesh.uv)[np.asarray(mesh.uv_faces)[face]])
    texel, weight, off = sampling_weights(atlas, uv, np.asarray(valid), mesh, face, weights)
    if atlas.skirt is not None and garment.template == "dress":
        hull, own = skirt_hull(body, np.asarray(rest)), atlas.num_body_texels
        share = _skirt_share(body, hull, garment).astype(np.float32)
        below, low, missed = skirt_samples(
            atlas.skirt, hull, np.asarray(garment.mesh.vertices), np.asarray(valid)[own:]
        )
        texel = np.concatenate([texel, own + below], axis=1)
        weight = np.concatenate([(1.0 - share)[:, None] * weight, share[:, None] * low], axis=1)
        good |= share == 1.0
        off = np.where(share == 1.0, missed, off)
    return Binding(
        Transference(
            jax.device_put(np.asarray(mesh.faces)[face]),
            jax.device_put(weights),
            jax.device_put(np.ones(face.shape, bool)),
            NUM_BODY_VERTICES,
        ),
        jax.device_put(texel),
        jax.device_put(weight),
        jax.device_put(np.float32(np.mean(good))),
        jax.device_put(np.int32(np.sum(~good))),
        jax.device_put(np.int32(off.sum())),
    )


def hit_rate(
    garment: Garment, *, body: Body, rest: Float[Array, "all 3"], most: int = 4000
) -> float:
    """Share of a garment's vertices whose ray meets the body, as `bind` finds it [1].

    Args:
        garment: Any garment on the body.
        body: The body.
        rest: Its rest vertices [m].
        most: Largest number of vertices that are looked at.
    """
    mesh = chart_mesh(make_atlas(32, body=body), body, rest, garment.template)
    rows = np.unique(np.linspace(0, garment.num_vertices - 1, most).astype(int))
    return float(np.mean(_hits(mesh, garment, rows)[0]))


def _hits(
    mesh: TriMesh, garment: Garment, rows: Int[np.ndarray, " rows"]
) -> tuple[Bool[np.ndarray, " rows"], Int[np.ndarray, " rows"], Float[np.ndarray, "rows 3"]]:
    """Which vertices' rays meet the skin, and the face and weights of the hit or closest point."""
    normals = vertex_normals(*map(np.asarray, (garment.mesh.vertices, garment.mesh.faces)))[rows]
    points = np.asarray(garment.mesh.vertices)[rows]
    face, weights, squared = _closest(mesh, points)
    reach = _MAX_DISTANCE_RATIO * np.sqrt(squared) + 0.01
    reach = np.minimum(reach, _MAX_DISTANCE[garment.template])
    if len(points) > _MANY:
        hits = cast_rays_within(mesh, points, normals, reach)
    else:
        # A block at a time: one program for garments of all sizes.
        padded = [padded_rows(x).reshape(-1, ROW_MULTIPLE, 3) for x in (points, normals)]
        most = _MAX_DISTANCE[garment.template]
        blocks = [
            cast_rays(mesh, *jax.device_put(block), both=True, max_distance=most)
            for block in zip(*padded, strict=True)
        ]
        hits = jax.tree.map(lambda *x: np.concatenate(x), *blocks)
    distance, ray_face, ray_weights = (
        np.asarray(x)[: len(points)] for x in (hits.distance, hits.face, hits.weights)
    )
    good = np.abs(distance) <= reach
    face = np.where(good, ray_face, face)
    return good, face, np.where(good[:, None], ray_weights, weights)


def _closest(
    mesh: TriMesh, points: Float[np.ndarray, "points 3"]
) -> tuple[Int[np.ndarray, " points"], Float[np.ndarray, "points 3"], Float[np.ndarray, " points"]]:
    """Closest face of each point, its weights there and the squared distance [m^2]."""
    near = nearby_faces(np.asarray(mesh.vertices), np.asarray(mesh.faces), points, neighbours=12)
    # Of faces that share the closest point, the first counts.
    near = np.sort(near, axis=1)
    return closest_on_host(np.asarray(mesh.vertices), np.asarray(mesh.faces), points, near)


def sampling_weights(
    atlas: Atlas,
    uv: Float[np.ndarray, "points 2"],
    valid: Bool[np.ndarray, " texels"],
    mesh: TriMesh,
    face: Int[np.ndarray, " points"],
    weights: Float[np.ndarray, "points 3"],
) -> tuple[Int[np.ndarray, "points 4"], Float[np.ndarray, "points 4"], Bool[np.ndarray, " points"]]:
    """Bilinear weights over valid texels that are neighbours on the body as well.

    Adjacent texels of the map may lie on different limbs. Texels more than a few texel
    widths from the point, measured on the body, are ignored. A point without remaining
    texels takes the texel nearest to it on the body.

    Returns:
        Rows of the atlas, weights that sum to 1, and which points took the nearest texel.
    """
    height, width, count = atlas.body_rows, atlas.width, atlas.num_body_texels
    row_of = np.full(height * width, -1)
    row_of[np.asarray(atlas.texels)[:count]] = np.arange(count)
    valid = valid[:count]
    x = uv[:, 0] * width - 0.5
    y = (1.0 - uv[:, 1]) * height - 0.5
    x0, y0 = np.floor(x).astype(int), np.floor(y).astype(int)
    fx, fy = x - x0, y - y0
    texel_points = np.asarray(atlas.to_body @ mesh.vertices)
    query_points = np.einsum(
        "vk,vkc->vc", weights, np.asarray(mesh.vertices)[np.asarray(mesh.faces)[face]]
    )
    texel = np.zeros((len(uv), 4), dtype=np.int32)
    weight = np.zeros((len(uv), 4))
    # One texel covers about 1.5 m / size of skin; seams are much farther apart.
    limit = 6.0 / min(height, width)
    for k, (dx, dy) in enumerate(((0, 0), (1, 0), (0, 1), (1, 1))):
        cx, cy = x0 + dx, y0 + dy
        inside = (cx >= 0) & (cx < width) & (cy >= 0) & (cy < height)
        flat = np.clip(cy, 0, height - 1) * width + np.clip(cx, 0, width - 1)
        row = np.where(inside, row_of[flat], -1)
        ok = (row >= 0) & valid[row]
        ok &= np.linalg.norm(texel_points[row] - query_points, axis=1) < limit
        w = np.where(dx, fx, 1 - fx) * np.where(dy, fy, 1 - fy)
        texel[:, k] = np.where(ok, row, 0)
        weight[:, k] = np.where(ok, w, 0.0)
    total = weight.sum(axis=1)
    unmatched = total < 1e-3
    if unmatched.any():
        rows = np.flatnonzero(valid)
        nearest = rows[KDTree(texel_points[rows]).query(query_points[unmatched])[1]]
        texel[unmatched] = nearest[:, None]
        weight[unmatched] = [1.0, 0.0, 0.0, 0.0]
        total = np.where(unmatched, 1.0, total)
    weight /= total[:, None]
    return texel, weight.astype(np.float32), unmatched


def _all_faces(body: Body) -> Array:
    return body.rest_mesh().faces
