"""The Laplacian of triangle meshes, by cotangents."""

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Int

# Largest cotangent: that of a triangle without area is infinite.
_MOST = 1e3


def cotangent_laplacian(
    faces: Int[np.ndarray, "faces 3"], cotangents: Float[np.ndarray, "faces 3"], n: int
) -> sp.csc_matrix:
    """The Laplacian from the cotangents of the angles at each triangle's corners.

    Args:
        faces: Triangles.
        cotangents: Of each corner's angle.
        n: Number of vertices.
    """
    i = np.concatenate([faces[:, k] for k in range(3)])
    j = np.concatenate([faces[:, (k + 1) % 3] for k in range(3)])
    w = np.concatenate([cotangents[:, (k + 2) % 3] for k in range(3)])
    off = sp.coo_matrix((w, (i, j)), (n, n))
    off = (off + off.T).tocsc()
    return sp.csc_matrix(sp.diags(np.asarray(off.sum(axis=1)).ravel()) - off)


def _cotangents(
    corners: Float[np.ndarray, "faces 3 axes"],
) -> Float[np.ndarray, "faces 3"]:
    """Cotangents of the angles of triangles."""
    out = np.empty(corners.shape[:2])
    for k in range(3):
        u = corners[:, (k + 1) % 3] - corners[:, k]
        v = corners[:, (k + 2) % 3] - corners[:, k]
        along = (u * v).sum(axis=1)
        square = (u * u).sum(axis=1) * (v * v).sum(axis=1) - along**2
        out[:, k] = along / np.sqrt(np.maximum(square, 1e-30))
    return np.clip(out, -_MOST, _MOST)


def mesh_laplacian(
    vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> tuple[Float[np.ndarray, " vertices"], sp.csc_matrix]:
    """Areas of vertices [m^2] and the integrated Laplacian of a mesh [1], positive semidefinite.

    Args:
        vertices: Positions [m].
        faces: Triangles.

    References:
        Pinkall and Polthier, Computing discrete minimal surfaces and their conjugates (1993).
    """
    corners = np.asarray(vertices, np.float64)[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.zeros(len(vertices))
    np.add.at(area, faces, (np.linalg.norm(cross, axis=1) / 6.0)[:, None])
    cotangents = _cotangents(corners)
    return area, 0.5 * cotangent_laplacian(faces, cotangents, len(vertices))
