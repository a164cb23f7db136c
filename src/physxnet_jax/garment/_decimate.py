"""Mesh decimation that keeps texture coordinates and materials."""

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components as components
from scipy.spatial import KDTree

from ..errors import MissingDependencyError
from ..geometry import TriMesh, make_mesh, mesh_edges
from ._repair import without_faults

# Number of candidates in the search for the nearest face.
_CANDIDATES = 16


def decimate(mesh: TriMesh, edge: float) -> tuple[TriMesh, Int[np.ndarray, " fewer"]]:
    """Decimates a mesh to about the face count of equilateral triangles of an edge length.

    Each corner takes the texture coordinates of the nearest point on the chart that its face
    comes from. Seams therefore stay seams, and no face spans one.

    Args:
        mesh: The mesh, without degenerate faces (see `clean`).
        edge: The edge length [m].

    Returns:
        The mesh, without coincident vertices and degenerate faces, and for each of its faces
        the original face nearest to its centroid among those facing the same way, shape [fewer].

    Raises:
        MissingDependencyError: fast-simplification isn't installed.
    """
    from trimesh import triangles

    x, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    area = float(triangles.area(x[faces]).sum())
    target_faces = max(int(area / (np.sqrt(3.0) / 4.0 * edge**2)), 4)
    if target_faces >= len(faces):
        return mesh, np.arange(len(faces))
    try:
        import fast_simplification
    except ImportError as error:
        raise MissingDependencyError(
            "Decimating needs fast-simplification: pip install 'physxnet-jax[mesh]'."
        ) from error
    points, fewer = fast_simplification.simplify(
        x, faces.astype(np.int32), target_count=target_faces
    )[:2]
    points, fewer = without_faults(np.asarray(points, np.float64), np.asarray(fewer, np.int64))
    origin = _origin_faces(x[faces], points[fewer])
    if mesh.uv is None or mesh.uv_faces is None:
        return make_mesh(points, fewer), origin
    uv, chart = np.asarray(mesh.uv, np.float64), np.asarray(mesh.uv_faces, np.int64)
    seen = _interpolate_uv(x[faces], uv[chart], chart, points[fewer], origin)
    rows, corner = np.unique(seen.reshape(-1, 2).astype(np.float32), axis=0, return_inverse=True)
    return make_mesh(points, fewer, rows, corner.reshape(-1, 3)), origin


def _origin_faces(
    fine: Float[np.ndarray, "faces 3 3"], coarse: Float[np.ndarray, "fewer 3 3"]
) -> Int[np.ndarray, " fewer"]:
    """The fine face nearest to each coarse centroid, among those facing the same way."""
    from trimesh import triangles

    middle = coarse.mean(axis=1)
    near = min(_CANDIDATES, len(fine))
    _, found = KDTree(fine.mean(axis=1)).query(middle, k=near)
    found = np.asarray(found).reshape(len(coarse), near)
    flat = found.reshape(-1)
    onto = triangles.closest_point(fine[flat], np.repeat(middle, near, axis=0))
    far = np.linalg.norm(onto.reshape(len(coarse), near, 3) - middle[:, None], axis=2)
    along = np.einsum("fni,fi->fn", _normals(fine)[found], _normals(coarse))
    # If none faces the same way, the nearest is taken.
    order = np.lexsort((far, along <= 0.0), axis=1)
    return found[np.arange(len(coarse)), order[:, 0]]


def _normals(corner: Float[np.ndarray, "faces 3 3"]) -> Float[np.ndarray, "faces 3"]:
    return np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])


def _interpolate_uv(
    fine: Float[np.ndarray, "faces 3 3"],
    fine_uv: Float[np.ndarray, "faces 3 2"],
    chart: Int[np.ndarray, "faces 3"],
    coarse: Float[np.ndarray, "fewer 3 3"],
    origin: Int[np.ndarray, " fewer"],
) -> Float[np.ndarray, "fewer 3 2"]:
    """Texture coordinates of coarse corners, each from the patch around its face's origin.

    A chart may meet itself at a seam, as a sleeve's does. Faces beyond such a seam are in the
    same chart, but not connected to the origin within the reach of one face.
    """
    from trimesh import triangles

    edges = mesh_edges(chart)
    a, b = edges.faces[edges.count == 2].astype(np.int64).T
    joined = coo_matrix((np.ones(len(a), np.int8), (a, b)), (len(fine), len(fine))).tocsr()
    centre, middle = fine.mean(axis=1), coarse.mean(axis=1)
    size = float(np.linalg.norm(fine - centre[:, None], axis=2).max())
    reach = np.linalg.norm(coarse - middle[:, None], axis=2).max(axis=1) + size
    reach = np.maximum(reach, np.linalg.norm(centre[origin] - middle, axis=1) * (1.0 + 1e-6))
    out = np.empty((len(coarse), 3, 2))
    balls = KDTree(centre).query_ball_point(middle, reach, return_sorted=True)
    for f, ball in enumerate(balls):
        near = np.asarray(ball, np.int64)
        part = components(joined[near][:, near], directed=False)[1]
        near = near[part == part[np.searchsorted(near, origin[f])]]
        rows = np.tile(near, 3)
        point = np.repeat(coarse[f], len(near), axis=0)
        onto = triangles.closest_point(fine[rows], point)
        best = np.linalg.norm(onto - point, axis=1).reshape(3, -1).argmin(axis=1)
        pick = best + len(near) * np.arange(3)
        share = triangles.points_to_barycentric(fine[rows[pick]], onto[pick])
        out[f] = np.einsum("ck,cki->ci", share, fine_uv[rows[pick]])
    return out
