"""Closest points on triangles, and signed distance to closed meshes."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..typing import pytree
from ._materialize import materialize
from ._mesh import TriMesh
from ._normals import face_normals, vertex_normals
from ._rotation import safe_normalize
from ._topology import mesh_edges

_A = TypeVar("_A", Array, np.ndarray)
_FACE_CHUNK = 256
_POINT_CHUNK = 256
# Derivatives of a quotient contain the inverse square of its denominator, which overflows
# float32 below this value. Edges so short count as points, triangles so thin as lines.
_MIN_SQUARE = 1e-18


@pytree
@dataclasses.dataclass(frozen=True)
class ClosestPoints:
    """Closest points of a mesh.

    Attributes:
        face: The face that holds the closest point, shape [points].
        weights: Its barycentric coordinates, all >= 0, sum 1, shape [points, 3].
        squared_distance: Squared distance [m^2], shape [points].
    """

    face: Int[Array, " points"]
    weights: Float[Array, "points 3"]
    squared_distance: Float[Array, " points"]


def closest_barycentric(
    p: Float[_A, " 3 *batch"],
    a: Float[_A, " 3 *batch"],
    b: Float[_A, " 3 *batch"],
    c: Float[_A, " 3 *batch"],
) -> tuple[Float[_A, " 3 *batch"], Float[_A, "*batch"]]:
    """Barycentric coordinates of the point of triangle abc closest to p.

    The component axis comes first, so that the work is element-wise over the rest.
    Values and gradients are finite for triangles degenerated to a line or a point. NumPy arrays
    give NumPy arrays, with nothing compiled.

    Args:
        p: Query points [m].
        a: First corners [m].
        b: Second corners [m].
        c: Third corners [m].

    Returns:
        Weights of a, b and c (>= 0, sum 1) and the squared distance [m^2].

    References:
        Ericson, Real-Time Collision Detection (2005), section 5.1.5.
    """
    xp: Any = np if isinstance(p, np.ndarray) else jnp
    ab, ac, bc = b - a, c - a, c - b
    ap, bp = p - a, p - b
    zero, one = xp.zeros_like(ap[0]), xp.ones_like(ap[0])

    def ratio(num: Any, den: Any) -> Any:
        ok = den > _MIN_SQUARE
        return xp.where(ok, num / xp.where(ok, den, one), zero)

    # Nearest of the three edges, computed separately: correct for any degeneracy.
    t = xp.clip(ratio(_dot(ab, ap), _dot(ab, ab)), 0.0, 1.0)
    gap = ap - t[None] * ab
    v, w, best = t, zero, _dot(gap, gap)
    for base, edge, is_bc in ((ap, ac, False), (bp, bc, True)):
        t = xp.clip(ratio(_dot(edge, base), _dot(edge, edge)), 0.0, 1.0)
        gap = base - t[None] * edge
        squared = _dot(gap, gap)
        near = squared < best
        v = xp.where(near, 1 - t if is_bc else zero, v)
        w = xp.where(near, t, w)
        best = xp.where(near, squared, best)
    # Interior of the triangle, if the projection of p lies in it.
    d00, d01, d11 = _dot(ab, ab), _dot(ab, ac), _dot(ac, ac)
    d20, d21 = _dot(ap, ab), _dot(ap, ac)
    det = d00 * d11 - d01 * d01
    v_in, w_in = ratio(d11 * d20 - d01 * d21, det), ratio(d00 * d21 - d01 * d20, det)
    gap = ap - v_in[None] * ab - w_in[None] * ac
    squared = _dot(gap, gap)
    inside = (det > _MIN_SQUARE) & (v_in > 0) & (w_in > 0) & (v_in + w_in < 1) & (squared <= best)
    v, w = xp.where(inside, v_in, v), xp.where(inside, w_in, w)
    if xp is jnp:
        v, w = materialize((v, w))
    return xp.stack([1 - v - w, v, w]), xp.where(inside, squared, best)


def _dot(x: Any, y: Any) -> Any:
    return x[0] * y[0] + x[1] * y[1] + x[2] * y[2]


@jax.jit
def closest_points(mesh: TriMesh, points: Float[Array, "points 3"]) -> ClosestPoints:
    """Finds exact closest points by comparison with every face, in chunks of faces.

    Memory is bounded by points x 256 faces. Time is points x faces: for repeated
    queries near a known position use candidates (`closest_among`).

    Args:
        mesh: The mesh.
        points: Query points [m].

    Returns:
        Closest faces, barycentric weights and squared distances. Ties go to the
        first face.
    """
    faces = mesh.faces
    n = faces.shape[0]
    chunk = min(_FACE_CHUNK, n)
    blocks = -(-n // chunk)
    index = jnp.minimum(jnp.arange(blocks * chunk, dtype=jnp.int32), n - 1)
    p = points.T[:, None, :]

    def step(carry: tuple[Array, Array, Array], block: Array) -> tuple[tuple, None]:
        best_d, best_f, best_w = carry
        corner = [mesh.vertices[faces[block, k]].T[:, :, None] for k in range(3)]
        q = jnp.broadcast_to(p, (3, chunk, points.shape[0]))
        w, d = closest_barycentric(q, *(jnp.broadcast_to(x, q.shape) for x in corner))
        near = jnp.argmin(d, axis=0)
        lane = jnp.arange(points.shape[0])
        d, w, f = d[near, lane], w[:, near, lane], block[near]
        better = d < best_d
        return (
            jnp.where(better, d, best_d),
            jnp.where(better, f, best_f),
            jnp.where(better[None], w, best_w),
        ), None

    m = points.shape[0]
    start = (
        jnp.full((m,), jnp.inf, points.dtype),
        jnp.zeros((m,), jnp.int32),
        jnp.zeros((3, m), points.dtype),
    )
    (d, f, w), _ = jax.lax.scan(step, start, index.reshape(blocks, chunk))
    return ClosestPoints(f, w.T, d)


@functools.partial(jax.jit, static_argnames="exactly")
def closest_among(
    mesh: TriMesh,
    points: Float[Array, "points 3"],
    candidates: Int[Array, "points k"],
    *,
    exactly: int | None = None,
) -> ClosestPoints:
    """Finds closest points among a short list of faces for each point.

    Args:
        mesh: The mesh.
        points: Query points [m].
        candidates: Faces to compare, shape [points, k].
        exactly: Compare only so many exactly, those with the nearest middles: several times as
            fast, and right where triangles are of similar size. All if None.

    Returns:
        As `closest_points`, over the candidates only.
    """
    corners = mesh.vertices[mesh.faces].reshape(-1, 9)
    p = points.T
    # Only the chosen triangle is differentiated: a gradient through all takes too much memory.
    fixed, at = jax.lax.stop_gradient((corners, p))
    if exactly is not None and exactly < candidates.shape[1]:
        candidates = _nearest_middles(fixed, at, candidates, exactly)
    face = _nearest(fixed, at, candidates)
    a, b, c = corners[face].T.reshape(3, 3, -1)
    weights, squared = closest_barycentric(p, a, b, c)
    return ClosestPoints(face, weights.T, squared)


def closest_on_host(
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    points: Float[np.ndarray, "points 3"],
    candidates: Int[np.ndarray, "points k"],
) -> tuple[Int[np.ndarray, " points"], Float[np.ndarray, "points 3"], Float[np.ndarray, " points"]]:
    """`closest_among` in NumPy: for tables that are made once, a program takes longer to compile.

    Args:
        vertices: Vertices of the mesh [m].
        faces: Its triangles.
        points: Query points [m].
        candidates: Faces to compare for each point; ties go to the first.

    Returns:
        The closest face of each point, its weights there and the squared distance [m^2].
    """
    found = []
    for at in range(0, max(len(points), 1), _POINT_CHUNK):
        near = candidates[at : at + _POINT_CHUNK]
        a, b, c = np.moveaxis(vertices[faces[near]], (2, 3), (0, 1))
        p = np.broadcast_to(points[at : at + _POINT_CHUNK].T[:, :, None], a.shape)
        weights, squared = (np.asarray(x) for x in closest_barycentric(p, a, b, c))
        row, best = np.arange(len(near)), np.argmin(squared, axis=1)
        found.append((near[row, best], weights[:, row, best].T, squared[row, best]))
    face, weights, squared = (np.concatenate(x) for x in zip(*found, strict=True))
    return face, weights, squared


def _nearest_middles(
    corners: Float[Array, "faces 9"],
    p: Float[Array, "3 points"],
    candidates: Int[Array, "points k"],
    count: int,
) -> Int[Array, "points count"]:
    """Those of each point's candidates whose middles are nearest."""
    order = candidates.T
    middles = materialize(jnp.sum(corners.reshape(-1, 3, 3), axis=1) / 3.0)
    x, y, z = (m[order] - q[None] for m, q in zip(middles.T, p, strict=True))
    return nearest_distinct(x * x + y * y + z * z, order, count).T


def _nearest(
    corners: Float[Array, "faces 9"],
    p: Float[Array, "3 points"],
    candidates: Int[Array, "points k"],
) -> Int[Array, " points"]:
    """The nearest of each point's candidates; ties go to the first."""
    # One array per coordinate, points last: CPUs vectorise this if the copies are made first.
    order = candidates.T
    copies = materialize(jnp.stack([c[order] for c in corners.T]))
    a, b, c = copies.reshape(3, 3, *order.shape)
    _, squared = closest_barycentric(jnp.broadcast_to(p[:, None], a.shape), a, b, c)
    near = fast_argmin(squared, axis=0)
    return candidates[jnp.arange(near.shape[0]), near].astype(jnp.int32)


def fast_argmin(values: Float[Array, "rows columns"], *, axis: int = 1) -> Int[Array, " others"]:
    """Index of the smallest value along an axis; ties go to the first.

    Unlike `jnp.argmin` it is vectorised on CPUs: ten times faster on wide rows. Where there
    is a NaN, the result is the last index.
    """
    index = jax.lax.broadcasted_iota(jnp.int32, values.shape, axis)
    # Values computed twice could round differently and equal no minimum.
    values = materialize(values)
    smallest = jnp.min(values, axis=axis, keepdims=True)
    return jnp.min(jnp.where(values <= smallest, index, values.shape[axis] - 1), axis=axis)


def nearest_index(squared: Float[Array, " rows *others"]) -> Int[Array, " *others"]:
    """Index along the first axis of the smallest value, among values that are not negative.

    Several times faster than `fast_argmin`: the index takes the place of the last bits of
    the values, so that a minimum suffices. Values that differ by less than twice the
    number of rows over 2^23 of their size count as equal; the first of those is chosen.

    Args:
        squared: Values of at least 0, as squared distances.
    """
    return nearest_indices(squared)[0]


def nearest_indices(
    *squared: Float[Array, " rows *others"],
) -> tuple[Int[Array, " *others"], ...]:
    """`nearest_index` of several arrays in one pass, into which their computation is fused."""
    keys, masks = zip(*(_indexed(x) for x in squared), strict=True)
    start = (jnp.iinfo(jnp.int32).max,) * len(keys)
    smallest = jax.lax.reduce(keys, tuple(map(jnp.int32, start)), _lower, (0,))
    rows = squared[0].shape[0]
    return tuple(jnp.minimum(x & m, rows - 1) for x, m in zip(smallest, masks, strict=True))


def nearest_distinct(
    squared: Float[Array, " rows *others"], labels: Int[Array, " rows *others"], count: int
) -> Int[Array, " count *others"]:
    """Labels of the smallest values along the first axis, the smallest first, each label once.

    One pass, into which the values' own computation is fused: twice as fast as a search that
    is repeated without what was found. As precise as `nearest_index`; values that count as equal
    may come in any order. Where there are fewer labels, the first row's is repeated.

    Args:
        squared: Values of at least 0, as squared distances; equal where labels are.
        labels: What is named, at least 0.
        count: Number of labels.
    """
    last, none = jnp.iinfo(jnp.int32).max, -1
    keys, _ = _indexed(squared)
    labels = labels.astype(jnp.int32)
    empty = (jnp.full_like(keys, last),) * (count - 1), (jnp.full_like(keys, none),) * (count - 1)
    start = (jnp.int32(last),) * count + (jnp.int32(none),) * count
    operands = (keys, *empty[0], labels, *empty[1])
    found = jax.lax.reduce(operands, start, _merger(count), (0,))[count:]
    return jnp.stack([jnp.where(x < 0, labels[0], x) for x in found])


def _lower(kept: tuple[Array, ...], more: tuple[Array, ...]) -> tuple[Array, ...]:
    return tuple(jnp.minimum(a, b) for a, b in zip(kept, more, strict=True))


@functools.cache
def _merger(count: int) -> Callable[[tuple[Array, ...], tuple[Array, ...]], tuple[Array, ...]]:
    """Merges sorted keys and their labels; one function for each count, or JAX traces anew."""

    def merged(kept: tuple[Array, ...], more: tuple[Array, ...]) -> tuple[Array, ...]:
        keys, names = list(kept[:count]), list(kept[count:])
        for key, name in zip(more[:count], more[count:], strict=True):
            known = functools.reduce(jnp.logical_or, (name == other for other in names))
            key = jnp.where(known, jnp.iinfo(jnp.int32).max, key)
            for k in range(count):
                less = key < keys[k]
                keys[k], key = jnp.where(less, key, keys[k]), jnp.where(less, keys[k], key)
                names[k], name = jnp.where(less, name, names[k]), jnp.where(less, names[k], name)
        return (*keys, *names)

    return merged


def _indexed(squared: Float[Array, " rows *others"]) -> tuple[Int[Array, " rows *others"], int]:
    """Values as integers of the same order that end in the index of their row, and its bits."""
    mask = (1 << max(squared.shape[0] - 1, 1).bit_length()) - 1
    bits = jax.lax.bitcast_convert_type(squared.astype(jnp.float32), jnp.int32)
    return (bits & ~mask) | jax.lax.broadcasted_iota(jnp.int32, squared.shape, 0), mask


def signed_distance(
    mesh: TriMesh,
    points: Float[Array, "points 3"],
    *,
    closest: ClosestPoints | None = None,
) -> Float[Array, " points"]:
    """Distance to a closed mesh [m], negative inside.

    The sign comes from the pseudonormal of the closest feature (face, edge or
    vertex), which is correct everywhere on a closed, consistently oriented mesh.

    Args:
        mesh: A closed mesh, faces outwards.
        points: Query points [m].
        closest: Known closest points; exact ones are computed if omitted.

    Returns:
        Signed distances.

    References:
        Baerentzen and Aanaes (2005).
    """
    hit = closest_points(mesh, points) if closest is None else closest
    edges = mesh_edges(np.asarray(mesh.faces))
    return _signed(mesh, points, hit, jax.device_put(edges.faces), jax.device_put(edges.of_face))


@jax.jit
def _signed(
    mesh: TriMesh,
    points: Float[Array, "points 3"],
    hit: ClosestPoints,
    beside: Int[Array, "edges 2"],
    of_face: Int[Array, "faces 3"],
) -> Float[Array, " points"]:
    normals = face_normals(mesh.vertices, mesh.faces)
    second = jnp.where(beside[:, 1] >= 0, beside[:, 1], beside[:, 0])
    edge_normals = normals[beside[:, 0]] + normals[second]
    corner_normals = vertex_normals(mesh.vertices, mesh.faces)
    tiny = 1e-6
    on: Bool[Array, "points 3"] = hit.weights <= tiny
    count = jnp.sum(on.astype(jnp.int32), axis=1)
    corner = jnp.argmax(hit.weights, axis=1)
    opposite_corner = jnp.argmin(hit.weights, axis=1)
    lane = jnp.arange(points.shape[0])
    tri = mesh.faces[hit.face]
    normal = jnp.where(
        (count >= 2)[:, None],
        corner_normals[tri[lane, corner]],
        jnp.where(
            (count == 1)[:, None],
            edge_normals[of_face[hit.face, opposite_corner]],
            normals[hit.face],
        ),
    )
    foot = jnp.einsum(
        "pk,pkc->pc", hit.weights, mesh.vertices[tri], precision=jax.lax.Precision.HIGHEST
    )
    gap = points - foot
    side = jnp.sum(gap * safe_normalize(normal), axis=1)
    squared = hit.squared_distance
    zero = squared <= 0
    one = jnp.ones_like(squared)
    distance = jnp.where(zero, jnp.zeros_like(squared), jnp.sqrt(jnp.where(zero, one, squared)))
    return jnp.where(side < 0, -distance, distance)
