"""Hollows of a surface, bridged as taut cloth does."""

import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float, Int

from ._topology import boundary_loops, mesh_edges, smoothing_matrix

# Steps needed grow with the square of a hollow's width in edges: 12 cm in edges of 1 cm.
_MOST_STEPS = 600
# Steps end when no vertex moves farther than this [m].
_STILL = 2e-5
# Cloth leaves the place where it was carried by this much at most [m].
_MOST = 0.08


def bridge_hollows(
    vertices: Float[np.ndarray, "vertices 3"],
    made: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    free: Bool[np.ndarray, " vertices"] | None = None,
) -> Float[np.ndarray, "vertices 3"]:
    """Moves cloth that was carried to another body out of hollows that it wasn't made with.

    Vertices move outwards only, along the normal of the cloth, until none lies deeper below
    the mean of its neighbours than it did on the body that the garment was made on. Borders
    stay.

    Args:
        vertices: Positions on the other body [m].
        made: Positions on the body that the garment was made on [m].
        faces: Triangles; they face outwards.
        free: Vertices that may move; all by default. Those of a thick garment's inner side, whose
            normals point to the body, must not.

    Returns:
        Positions [m]; those of `vertices` where the cloth has no new hollow.

    References:
        Taut cloth over a body is a surface of least area that doesn't enter it: mean
        curvature flow with an obstacle.
    """
    n = len(vertices)
    around = smoothing_matrix(faces, n)
    free = np.ones(n, bool) if free is None else free.copy()
    for loop in boundary_loops(faces):
        free[loop] = False
    start, before = np.asarray(vertices, np.float64), np.asarray(made, np.float64)
    incidence = _incidence(faces, n)
    larger = _spacing(start, faces) / _spacing(before, faces)
    allowed = larger * np.maximum(_depth(before, faces, around, incidence)[0], 0.0)
    x, raised = start.copy(), np.zeros(n)
    for _ in range(_MOST_STEPS):
        depth, normal = _depth(x, faces, around, incidence)
        move = np.where(free, np.maximum(depth - allowed, 0.0), 0.0)
        move = np.minimum(move, _MOST - raised)
        if move.max(initial=0.0) < _STILL:
            break
        raised += move
        x += move[:, None] * normal
    return np.where((raised > 0.0)[:, None], x, start).astype(vertices.dtype)


def _incidence(faces: Int[np.ndarray, "faces 3"], n: int) -> sp.csr_matrix:
    """Which faces a vertex belongs to, [vertices, faces]."""
    rows, columns = faces.ravel(), np.repeat(np.arange(len(faces)), 3)
    return sp.csr_matrix((np.ones(len(rows)), (rows, columns)), (n, len(faces)))


def _depth(
    x: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    around: sp.csr_matrix,
    incidence: sp.csr_matrix,
) -> tuple[Float[np.ndarray, " vertices"], Float[np.ndarray, "vertices 3"]]:
    """Half the depth of vertices below the mean of their neighbours [m], and their normals."""
    a, b, c = (x[faces[:, k]] for k in range(3))
    normal = incidence @ np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    return np.einsum("vc,vc->v", around @ x - x, normal), normal


def _spacing(x: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]) -> float:
    """Mean length of the edges [m]."""
    ends = x[np.asarray(mesh_edges(faces).vertices)]
    return float(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1).mean())
