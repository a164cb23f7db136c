"""Watertight ray casting against triangle meshes, in chunks of bounded memory."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..typing import pytree
from ._mesh import TriMesh
from ._rotation import safe_norm
from ._topology import mesh_edges

# Rays per chunk: [vertices, rays] blocks of a 13,000-vertex body then fit the cache.
_CHUNK = 64


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
        jnp.asarray(faces),
        jnp.asarray(edges.vertices),
        jnp.asarray(edges.of_face),
        jnp.asarray(sign, dtype=mesh.vertices.dtype),
        jnp.asarray(origins),
        jnp.asarray(directions),
        jnp.asarray(max_distance, dtype=mesh.vertices.dtype),
        both,
    )


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
