"""Overlapping patches of a mesh."""

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Int
from scipy.sparse.csgraph import dijkstra

from ._topology import mesh_edges

# Patches that a vertex belongs to, and their width over the distance of their middles [1].
_SHARED, _WIDTH = 4, 0.7


def patch_shares(
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    spacing: float,
) -> sp.csr_matrix:
    """Shares of patches in vertices: a partition of unity, smooth along the mesh.

    Middles are farthest points: each lies where all before it are farthest.

    Args:
        vertices: Positions [m].
        faces: Triangles.
        spacing: Largest distance of a vertex to the nearest middle, along edges [m].

    Returns:
        A matrix of vertices by patches, whose rows sum to 1.
    """
    edges = mesh_edges(faces).vertices
    length = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
    graph = sp.csr_matrix(
        (np.maximum(length, 1e-9), (edges[:, 0], edges[:, 1])), (len(vertices), len(vertices))
    )
    found, nearest = [], np.full(len(vertices), np.inf)
    while nearest.max() > spacing:
        far = dijkstra(graph, directed=False, indices=int(nearest.argmax()), limit=4.0 * spacing)
        found.append(far)
        nearest = np.minimum(nearest, far)
    distance = np.stack(found, axis=1)
    chosen = np.argsort(distance, axis=1, kind="stable")[:, :_SHARED]
    share = np.exp(-((np.take_along_axis(distance, chosen, axis=1) / (_WIDTH * spacing)) ** 2))
    share /= share.sum(axis=1, keepdims=True)
    rows = np.repeat(np.arange(len(vertices)), chosen.shape[1])
    matrix = sp.csr_matrix((share.ravel(), (rows, chosen.ravel())), distance.shape)
    matrix.eliminate_zeros()
    return matrix
