"""Watertight ray casting against triangle meshes, in chunks of bounded memory."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.spatial import KDTree

from ..typing import pytree
from ._mesh import TriMesh
from ._rotation import safe_norm
from ._topology import mesh_edges

# Rays per chunk: [vertices, rays] blocks of a 13,000-vertex body then fit the cache.
_CHUNK = 64
# Rays of a block that share triangles, and the largest number of triangles of a call.
_BLOCK, _MOST_FACES = 64, 400_000
# What the boxes around rays are larger by, for rounding [m].
_SLACK = 1e-5


@pytree
@dataclasses.dataclass(frozen=True)
class RayHits:
    """Nearest hits of rays.

    Attributes:
        face: Face hit, 0 where there is none, shape [rays].
        weights: Barycentric coordinates of the hit, zero without one, shape [rays, 3].
        distance: Signed distance along the unit direction [m], infinity without a
            hit, shape [rays].
        valid: Whether anything was hit, shape [rays].
    """

    face: Int[Array, " rays"]
    weights: Float[Array, "rays 3"]
    distance: Float[Array, " rays"]
    valid: Bool[Array, " rays"]


def cast_rays(
    mesh: TriMesh,
    origins: Float[Array, "rays 3"],
    directions: Float[Array, "rays 3"],
    *,
    both: bool = False,
    max_distance: float = np.inf,
) -> RayHits:
    """First intersection of each ray with a mesh, from either side of its faces.

    Watertight: the sign of every edge function is computed once for each edge and
    shared by the faces beside it, so a ray can't slip between two triangles, through
    an edge or through a vertex, whatever the rounding. Triangles seen edge-on count
    as missed; the ray hits their neighbours. Zero directions hit nothing.

    Args:
        mesh: The mesh to intersect. Degenerate triangles are never hit.
        origins: Ray origins [m].
        directions: Ray directions, any length; they are normalised.
        both: Also cast backwards and take the nearer hit; backward distances are negative.
        max_distance: Maximum distance of a hit [m].

    Returns:
        The nearest hits.

    Raises:
        MeshError: See `make_mesh`, which checks meshes.

    Example:
        >>> from physxnet_jax.geometry import make_mesh
        >>> mesh = make_mesh([[0, 0, 1], [1, 0, 1], [0, 1, 1]], [[0, 1, 2]])
        >>> hits = cast_rays(mesh, jnp.array([[.2, .2, 0]]), jnp.array([[0, 0, 2.]]))
        >>> float(hits.distance[0])
        1.0

    References:
        Woop, Benthin and Wald, Watertight ray/triangle intersection (2013): the
        shear; the shared edge functions replace its double precision fallback.
        PhysXNet, section 4.2: rays along normals define the transference matrices.
    """
    edges = mesh_edges(np.asarray(mesh.faces))
    faces = np.asarray(mesh.faces)
    # Edge functions are stored for the edge from its lower to its higher vertex.
    sign = np.stack(
        [np.where(faces[:, (k + 1) % 3] < faces[:, (k + 2) % 3], 1, -1) for k in range(3)],
        axis=1,
    ).astype(np.float32)
    return _cast(
        mesh.vertices,
        jax.device_put(faces),
        jax.device_put(edges.vertices),
        jax.device_put(edges.of_face),
        jnp.asarray(sign, dtype=mesh.vertices.dtype),
        jnp.asarray(origins),
        jnp.asarray(directions),
        jnp.asarray(max_distance, dtype=mesh.vertices.dtype),
        both,
    )


def cast_rays_within(
    mesh: TriMesh,
    origins: Float[np.ndarray, "rays 3"],
    directions: Float[np.ndarray, "rays 3"],
    reach: Float[np.ndarray, " rays"],
) -> RayHits:
    """Intersection of each ray with a mesh nearest to its origin, both ways, within a reach.

    As `cast_rays` with ``both``, but each block of rays meets only the triangles that it can
    reach: a garment's rays meet the skin beneath them, not the whole body. Runs on the host.

    Args:
        mesh: The mesh to intersect.
        origins: Ray origins [m].
        directions: Ray directions, any length.
        reach: Maximum distance of each ray's hit [m].

    Returns:
        The nearest hits.
    """
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    corners = vertices[faces]
    middle = corners.mean(axis=1)
    size = float(np.linalg.norm(corners - middle[:, None], axis=2).max())
    tree, count = KDTree(middle), len(origins)
    # Rays of one leaf of a tree lie beside each other.
    order = KDTree(origins, leafsize=_BLOCK).indices
    blocks = np.resize(order, -(-count // _BLOCK) * _BLOCK).reshape(-1, _BLOCK)
    centre = origins[blocks].mean(axis=1)
    radius = np.linalg.norm(origins[blocks] - centre[:, None], axis=2) + reach[blocks]
    found = tree.query_ball_point(centre, radius.max(axis=1) + size)
    # Of these, the triangles that touch the box around the rays.
    unit = directions / np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-12)
    along = (unit * (1.001 * reach + _SLACK)[:, None])[blocks]
    low = (origins[blocks] - np.abs(along)).min(axis=1)
    high = (origins[blocks] + np.abs(along)).max(axis=1)
    least, most = corners.min(axis=1), corners.max(axis=1)
    for k, n in enumerate(found):
        n = np.asarray(n, np.int64)
        touches = (least[n] <= high[k]).all(axis=1) & (most[n] >= low[k]).all(axis=1)
        found[k] = n[touches]
    # Powers of two and four, so that few programs are compiled.
    width = np.array([1 << max((len(n) - 1).bit_length(), 8) for n in found])
    turned = (np.roll(faces, -1, axis=1) > np.roll(faces, -2, axis=1))[:, :, None]
    # The ends of each edge in the order of their numbers, as faces on both sides see it.
    ends = np.stack([np.roll(corners, -1, axis=1), np.roll(corners, -2, axis=1)], axis=2)
    ends = np.where(turned[..., None], ends[:, :, ::-1], ends)
    sign = np.where(turned[..., 0], -1.0, 1.0)
    out = [np.zeros(count, np.int32), np.zeros((count, 3)), np.full(count, np.inf)]
    for w in np.unique(width):
        at = np.flatnonzero(width == w)
        rows = np.zeros((len(at), w), np.int64)
        for k, n in enumerate(at):
            rows[k, : len(found[n])] = found[n]
        for part in np.array_split(np.arange(len(at)), -(-len(at) * w // _MOST_FACES)):
            calls = 4 ** ((len(part) - 1).bit_length() + 1 >> 1)
            padded = part[np.minimum(np.arange(calls), len(part) - 1)]
            b, r = blocks[at[padded]], rows[padded]
            arrays = (corners[r], ends[r], sign[r], origins[b], directions[b], reach[b])
            hits = _cast_blocks(*(jnp.asarray(a, jnp.float32) for a in arrays))
            index, weights, distance = (np.asarray(h)[: len(part)] for h in hits)
            ray = b[: len(part)].reshape(-1)
            near = np.take_along_axis(r[: len(part)], index.astype(np.int64), axis=1)
            for store, value in zip(out, (near, weights, distance), strict=True):
                store[ray] = value.reshape(-1, *value.shape[2:])
    valid = np.isfinite(out[2])
    return RayHits(
        jax.device_put(np.where(valid, out[0], 0).astype(np.int32)),
        jnp.asarray(out[1], jnp.float32),
        jnp.asarray(out[2], jnp.float32),
        jax.device_put(valid),
    )


@jax.jit
def _cast_blocks(
    corners: Array, ends: Array, sign: Array, origins: Array, directions: Array, reach: Array
) -> tuple[Array, Array, Array]:
    """Nearest of its block's triangles that each ray hits: its row, weights and distance."""

    def block(arrays: tuple[Array, ...]) -> tuple[Array, Array, Array]:
        corner, end, sign, origin, direction, reach = arrays
        length = safe_norm(direction)
        unit = direction / jnp.where(length > 0, length, 1.0)[:, None]
        kz = jnp.argmax(jnp.abs(unit), axis=1)
        axes = jnp.stack([(kz + 1) % 3, (kz + 2) % 3, kz], axis=1)
        s = jnp.take_along_axis(unit, axes, axis=1)
        dz = jnp.where(length > 0, s[:, 2], 1.0)
        slope = (s / dz[:, None]).T[:, None, None]
        # Shape [faces, 3, rays] and [faces, 3, 2, rays].
        depth = _along(corner, origin, axes[:, 2]) / dz[None, None]
        ex, ey, ez = (_along(end, origin, axes[:, k]) for k in range(3))
        ex, ey = ex - slope[0][None] * ez, ey - slope[1][None] * ez
        function = (ex[:, :, 0] * ey[:, :, 1] - ey[:, :, 0] * ex[:, :, 1]) * sign[..., None]
        inside = (function >= 0).all(axis=1) | (function <= 0).all(axis=1)
        det = function.sum(axis=1)
        inside &= (det != 0) & (length > 0)[None]
        inverse = 1.0 / jnp.where(det != 0, det, 1.0)
        t = (function * depth).sum(axis=1) * inverse
        away = jnp.where(inside & (jnp.abs(t) <= reach[None]), jnp.abs(t), jnp.inf)
        best = jnp.argmin(away, axis=0)
        lane = jnp.arange(len(origin))
        hit = jnp.isfinite(away[best, lane])
        weights = function[best, :, lane] * inverse[best, lane][:, None]
        return (
            best.astype(jnp.int32),
            jnp.where(hit[:, None], weights, 0.0),
            jnp.where(hit, t[best, lane], jnp.inf),
        )

    return jax.lax.map(block, (corners, ends, sign, origins, directions, reach))


def _along(points: Array, origin: Array, axis: Array) -> Array:
    """Coordinates of points relative to each ray's origin, along its axis; rays last."""
    others = (1,) * (points.ndim - 1)
    relative = [points[..., c, None] - origin[:, c].reshape(*others, -1) for c in range(3)]
    axis = jnp.broadcast_to(axis.reshape(*others, -1), relative[0].shape)
    return jnp.where(axis == 0, relative[0], jnp.where(axis == 1, relative[1], relative[2]))


@jax.jit(static_argnames="both")
def _cast(
    vertices: Array,
    faces: Array,
    edges: Array,
    of_face: Array,
    sign: Array,
    origins: Array,
    directions: Array,
    max_distance: Array,
    both: bool,
) -> RayHits:
    rays = origins.shape[0]
    chunk = min(_CHUNK, max(rays, 1))
    padded = -(-rays // chunk) * chunk
    pad = ((0, padded - rays), (0, 0))
    blocks = (
        jnp.pad(origins, pad).reshape(-1, chunk, 3),
        jnp.pad(directions, pad).reshape(-1, chunk, 3),
    )
    hits = jax.lax.map(
        lambda ray: _cast_chunk(
            vertices, faces, edges, of_face, sign, ray[0], ray[1], max_distance, both
        ),
        blocks,
    )
    return jax.tree.map(lambda x: x.reshape((-1, *x.shape[2:]))[:rays], hits)


def _cast_chunk(
    vertices: Array,
    faces: Array,
    edges: Array,
    of_face: Array,
    sign: Array,
    origins: Array,
    directions: Array,
    max_distance: Array,
    both: bool,
) -> RayHits:
    """Hits of a chunk of rays; the ray axis is last, so gathers move whole rows."""
    dtype = vertices.dtype
    length = safe_norm(directions)
    usable = length > 0
    unit = directions / jnp.where(usable, length, 1.0)[:, None]
    kz = jnp.argmax(jnp.abs(unit), axis=1)
    kx, ky = (kz + 1) % 3, (kz + 2) % 3
    lane = jnp.arange(unit.shape[0])
    dz = unit[lane, kz]
    dz = jnp.where(usable, dz, jnp.ones_like(dz))
    sx, sy = unit[lane, kx] / dz, unit[lane, ky] / dz
    onehot = [jax.nn.one_hot(k, 3, dtype=dtype).T for k in (kx, ky, kz)]
    relative = [vertices[:, c, None] - origins[None, :, c] for c in range(3)]

    def axis(k: int) -> Array:
        # A permutation by selection is exact; a sum of products with 0 and 1 isn't for
        # infinities.
        one = onehot[k][:, None, :] > 0
        return jnp.where(one[0], relative[0], jnp.where(one[1], relative[1], relative[2]))

    z = axis(2)
    x = axis(0) - sx[None] * z
    y = axis(1) - sy[None] * z
    depth = z / dz[None]
    a, b = edges[:, 0], edges[:, 1]
    function = x[a] * y[b] - y[a] * x[b]
    u, v, w = (function[of_face[:, k]] * sign[:, k, None] for k in range(3))
    inside = ((u >= 0) & (v >= 0) & (w >= 0)) | ((u <= 0) & (v <= 0) & (w <= 0))
    det = u + v + w
    inside &= (det != 0) & usable[None]
    inverse = 1.0 / jnp.where(det != 0, det, jnp.ones_like(det))
    t = (u * depth[faces[:, 0]] + v * depth[faces[:, 1]] + w * depth[faces[:, 2]]) * inverse
    reach = jnp.abs(t) if both else jnp.where(t >= 0, t, jnp.inf)
    reach = jnp.where(inside & (reach <= max_distance), reach, jnp.inf)
    best = jnp.argmin(reach, axis=0)
    valid = jnp.isfinite(reach[best, lane])
    bary = jnp.stack([u[best, lane], v[best, lane], w[best, lane]], axis=1)
    bary = bary * inverse[best, lane][:, None]
    return RayHits(
        jnp.where(valid, best, 0).astype(jnp.int32),
        jnp.where(valid[:, None], bary, jnp.zeros_like(bary)),
        jnp.where(valid, t[best, lane], jnp.inf),
        valid,
    )
