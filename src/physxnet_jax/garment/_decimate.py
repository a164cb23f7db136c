"""A mesh of fewer faces that looks like the finer one: its texture and its materials."""

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components as components
from scipy.spatial import KDTree

from ..errors import MissingDependencyError
from ..geometry import TriMesh, make_mesh, mesh_edges

# Faces looked at for the nearest one.
_NEAR = 16


def decimate(mesh: TriMesh, edge: float) -> tuple[TriMesh, Int[np.ndarray, " fewer"]]:
    """About as few faces as equilateral ones of an edge length [m] would be.

    Every corner has the texture coordinates of the nearest point on the piece of the
    texture that its face is from: seams stay seams, and no face reaches across one.

    Args:
        mesh: The mesh; faces without an area aren't in it (`clean`).
        edge: The edge length [m].

    Returns:
        The mesh, and the face before that lies nearest to the middle of each of its faces
        and faces the same way, shape [fewer].

    Raises:
        MissingDependencyError: Without fast-simplification.
    """
    from trimesh import triangles

    x, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    area = float(triangles.area(x[faces]).sum())
    wanted = max(int(area / (np.sqrt(3.0) / 4.0 * edge**2)), 4)
    if wanted >= len(faces):
        return mesh, np.arange(len(faces))
    try:
        import fast_simplification
    except ImportError as error:
        raise MissingDependencyError(
            "Decimating needs fast-simplification: pip install 'physxnet-jax[mesh]'."
        ) from error
    points, fewer = fast_simplification.simplify(x, faces.astype(np.int32), target_count=wanted)[:2]
    points, fewer = np.asarray(points, np.float64), np.asarray(fewer, np.int64)
    origin = _origins(x[faces], points[fewer])
    if mesh.uv is None or mesh.uv_faces is None:
        return make_mesh(points, fewer), origin
    uv, chart = np.asarray(mesh.uv, np.float64), np.asarray(mesh.uv_faces, np.int64)
    seen = _texture(x[faces], uv[chart], chart, points[fewer], origin)
    rows, corner = np.unique(seen.reshape(-1, 2).astype(np.float32), axis=0, return_inverse=True)
    return make_mesh(points, fewer, rows, corner.reshape(-1, 3)), origin


def _origins(
    fine: Float[np.ndarray, "faces 3 3"], coarse: Float[np.ndarray, "fewer 3 3"]
) -> Int[np.ndarray, " fewer"]:
    """The fine face nearest to the middle of each coarse one, of those that face its way."""
    from trimesh import triangles

    middle = coarse.mean(axis=1)
    near = min(_NEAR, len(fine))
    _, found = KDTree(fine.mean(axis=1)).query(middle, k=near)
    found = np.asarray(found).reshape(len(coarse), near)
    flat = found.reshape(-1)
    onto = triangles.closest_point(fine[flat], np.repeat(middle, near, axis=0))
    far = np.linalg.norm(onto.reshape(len(coarse), near, 3) - middle[:, None], axis=2)
    along = np.einsum("fni,fi->fn", _normals(fine)[found], _normals(coarse))
    # Where none faces its way the nearest has to do.
    order = np.lexsort((far, along <= 0.0), axis=1)
    return found[np.arange(len(coarse)), order[:, 0]]


def _normals(corner: Float[np.ndarray, "faces 3 3"]) -> Float[np.ndarray, "faces 3"]:
    return np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])


def _texture(
    fine: Float[np.ndarray, "faces 3 3"],
    fine_uv: Float[np.ndarray, "faces 3 2"],
    chart: Int[np.ndarray, "faces 3"],
    coarse: Float[np.ndarray, "fewer 3 3"],
    origin: Int[np.ndarray, " fewer"],
) -> Float[np.ndarray, "fewer 3 2"]:
    """Texture coordinates of coarse corners, each from the patch around its face's origin.

    A sleeve's texture may meet itself at a seam: what lies on the other side of it is in the
    same piece, but not joined to the origin within the reach of one face.
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
