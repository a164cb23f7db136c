"""Short lists of faces near points, from a k-d tree on the host."""

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from ._topology import vertex_faces


def nearby_faces(
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    points: Float[np.ndarray, "points 3"],
    *,
    neighbours: int = 6,
) -> Int[np.ndarray, "points k"]:
    """Faces around the mesh vertices nearest to each point.

    They suffice for `closest_among` on meshes without long thin triangles: the closest
    face nearly always touches one of the nearest vertices.

    Args:
        vertices: Mesh vertices [m].
        faces: Mesh faces.
        points: Query points [m].
        neighbours: Number of nearest vertices whose faces are taken.

    Returns:
        Face indices, with repetitions where a vertex has few faces.
    """
    around = vertex_faces(faces, len(vertices))
    used = np.unique(faces)
    k = min(neighbours, len(used))
    near = KDTree(vertices[used]).query(points, k=k)[1].reshape(len(points), k)
    return around[used[near]].reshape(len(points), -1)


def spread_points(
    points: Float[np.ndarray, "points 3"], spacing: float
) -> Int[np.ndarray, " chosen"]:
    """Indices of points at least ``spacing`` [m] apart, chosen greedily in order.

    Every other point has a chosen one within ``spacing``.
    """
    tree = KDTree(points)
    free = np.ones(len(points), dtype=bool)
    chosen = []
    for i in range(len(points)):
        if free[i]:
            chosen.append(i)
            free[tree.query_ball_point(points[i], spacing)] = False
    return np.asarray(chosen, dtype=np.int64)
