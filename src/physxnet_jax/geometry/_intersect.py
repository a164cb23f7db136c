"""Self-intersection of triangle meshes, on the host."""

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from ._topology import mesh_edges


def self_intersections(
    vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> Int[np.ndarray, "pairs 2"]:
    """Pairs (edge, face) of a mesh that cross in their interiors.

    Pairs that share a vertex are excluded. Candidates come from bounding spheres, so no
    crossing is missed. The test itself runs in float64.

    Args:
        vertices: Positions [m].
        faces: Triangles.

    Returns:
        Rows of (edge index in `mesh_edges`, face index).
    """
    v = np.asarray(vertices, dtype=np.float64)
    f = np.asarray(faces)
    e = mesh_edges(f).vertices
    mid = 0.5 * (v[e[:, 0]] + v[e[:, 1]])
    reach = 0.5 * np.linalg.norm(v[e[:, 0]] - v[e[:, 1]], axis=1)
    centre = v[f].mean(axis=1)
    radius = np.linalg.norm(v[f] - centre[:, None], axis=2).max(axis=1)
    tree = KDTree(centre)
    near = tree.query_ball_point(mid, reach + radius.max())
    edge = np.repeat(np.arange(len(e)), [len(n) for n in near])
    face = np.concatenate([np.asarray(n, dtype=np.int64) for n in near])
    close = np.linalg.norm(mid[edge] - centre[face], axis=1) <= reach[edge] + radius[face]
    shared = (e[edge][:, :, None] == f[face][:, None, :]).any(axis=(1, 2))
    edge, face = edge[close & ~shared], face[close & ~shared]
    p, q = v[e[edge, 0]], v[e[edge, 1]]
    a, b, c = (v[f[face, k]] for k in range(3))

    def volume(x: np.ndarray, y: np.ndarray, z: np.ndarray, w: np.ndarray) -> np.ndarray:
        return np.einsum("ij,ij->i", x - w, np.cross(y - w, z - w))

    sides = volume(a, b, c, p) * volume(a, b, c, q) < 0
    s = [volume(p, q, a, b), volume(p, q, b, c), volume(p, q, c, a)]
    through = ((s[0] > 0) & (s[1] > 0) & (s[2] > 0)) | ((s[0] < 0) & (s[1] < 0) & (s[2] < 0))
    hit = sides & through
    return np.column_stack([edge[hit], face[hit]])
