"""Flattens a piece of surface into the plane with little stretch: the paper pattern of cloth."""

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Int
from scipy.sparse.linalg import splu
from scipy.spatial import KDTree

from ...geometry import cotangent_laplacian

# Cotangents are kept within these limits, so that thin triangles can't make the system indefinite.
_COTANGENTS = (0.05, 10.0)


def flatten(
    points: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    start: Float[np.ndarray, "vertices 2"],
    *,
    on_axis: Int[np.ndarray, " axis"] | None = None,
    steps: int = 100,
) -> Float[np.ndarray, "vertices 2"]:
    """Flattens a surface as rigidly as possible.

    Args:
        points: Vertices [m].
        faces: Triangles, anticlockwise in ``start``.
        start: A first flattening [m], of the right orientation nearly everywhere.
        on_axis: Vertices whose first coordinate stays 0, if any.
        steps: Number of steps.

    Returns:
        Positions in the plane [m].

    References:
        Liu et al., A local/global approach to mesh parameterization (SGP 2008).
    """
    local, cotangents = _triangles(points, faces)
    n = len(points)
    # A trace of the identity makes the system regular; the mean is removed afterwards.
    laplacian = (cotangent_laplacian(faces, cotangents, n) + 1e-9 * sp.identity(n)).tocsc()
    free = np.setdiff1d(np.arange(n), [] if on_axis is None else on_axis)
    across, along = splu(laplacian[free][:, free].tocsc()), splu(laplacian)
    uv = np.array(start, dtype=np.float64)
    for _ in range(steps):
        spin = np.zeros((len(faces), 2))
        for i, j, w in _sides(cotangents):
            d, q = local[:, i] - local[:, j], uv[faces[:, i]] - uv[faces[:, j]]
            spin[:, 0] += w * (q * d).sum(axis=1)
            spin[:, 1] += w * (q[:, 1] * d[:, 0] - q[:, 0] * d[:, 1])
        spin /= np.maximum(np.linalg.norm(spin, axis=1, keepdims=True), 1e-30)
        c, s = spin.T
        right = np.zeros((n, 2))
        for i, j, w in _sides(cotangents):
            d = local[:, i] - local[:, j]
            turned = w[:, None] * np.column_stack(
                [c * d[:, 0] - s * d[:, 1], s * d[:, 0] + c * d[:, 1]]
            )
            np.add.at(right, faces[:, i], turned)
            np.add.at(right, faces[:, j], -turned)
        uv = np.zeros((n, 2))
        uv[free, 0] = across.solve(right[free, 0])
        uv[:, 1] = along.solve(right[:, 1])
        uv[:, 1] -= uv[:, 1].mean()
        if on_axis is None:
            uv[:, 0] -= uv[:, 0].mean()
    return uv


def _sides(cotangents: Float[np.ndarray, "faces 3"]):
    """Corners at the ends of each side, and its weight."""
    return ((k, (k + 1) % 3, cotangents[:, (k + 2) % 3]) for k in range(3))


def _triangles(
    points: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> tuple[Float[np.ndarray, "faces 3 2"], Float[np.ndarray, "faces 3"]]:
    """Corners of each triangle in a plane of its own, and the cotangents of its angles."""
    a, b, c = (points[faces[:, k]] for k in range(3))
    length = np.linalg.norm(b - a, axis=1)
    x = (b - a) / length[:, None]
    normal = np.cross(b - a, c - a)
    y = np.cross(normal / np.linalg.norm(normal, axis=1, keepdims=True), x)
    local = np.zeros((len(faces), 3, 2))
    local[:, 1, 0] = length
    local[:, 2, 0], local[:, 2, 1] = ((c - a) * x).sum(axis=1), ((c - a) * y).sum(axis=1)
    cotangents = np.empty((len(faces), 3))
    for k in range(3):
        u = local[:, (k + 1) % 3] - local[:, k]
        v = local[:, (k + 2) % 3] - local[:, k]
        cotangents[:, k] = (u * v).sum(axis=1) / np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0])
    return local, np.clip(cotangents, *_COTANGENTS)


def nearest_triangle(
    nodes: Float[np.ndarray, "nodes 2"],
    uv: Float[np.ndarray, "vertices 2"],
    tri: Int[np.ndarray, "pieces 3"],
) -> tuple[Int[np.ndarray, " nodes"], Float[np.ndarray, "nodes 3"]]:
    """Nearest triangle of each node, and its barycentric coordinates there, negative outside."""
    corners = uv[tri]
    a, b, c = (corners[:, k] for k in range(3))
    inverse = np.linalg.inv(np.stack([b - a, c - a], axis=2))
    tree = KDTree(corners.mean(axis=1))
    near = np.asarray(tree.query(nodes, k=24)[1])
    d = nodes[:, None] - a[near]
    st = np.einsum("nkij,nkj->nki", inverse[near], d)
    share = np.concatenate([1 - st.sum(axis=2, keepdims=True), st], axis=2)
    # Inside, the smallest share is positive; outside, the least negative one is nearest.
    size = np.sqrt(np.abs(np.linalg.det(np.stack([b - a, c - a], axis=2))))
    inside = np.minimum(share.min(axis=2), 0.0) * size[near]
    best = np.argmax(inside, axis=1)
    lane = np.arange(len(nodes))
    return near[lane, best], share[lane, best]
