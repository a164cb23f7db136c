"""Clearance between a garment and the skin at rest."""

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float, Int
from scipy.sparse.csgraph import dijkstra
from scipy.sparse.linalg import spsolve

from ..geometry import (
    FINE_MESH,
    NUM_SITES,
    TriMesh,
    boundary_loops,
    closest_among,
    closest_points,
    coarse_mesh,
    linear_weights,
    mesh_edges,
    nearby_faces,
    self_intersections,
    signed_distance,
    smoothing_matrix,
    vertex_normals,
)

Clearance = tuple[Float[np.ndarray, " points"], Float[np.ndarray, "points 3"]]
"""Signed distances to the body [m], and directions away from it."""

_ROWS = 2048
# Hanging cloth farther from the skin than this isn't lifted off it [m].
_NEAR = 0.03
# Fine meshes are lifted at their sites; the last passes, without smoothing, act on all vertices.
_LAST = 2


def clearance(body: TriMesh, points: Float[np.ndarray, "points 3"]) -> Clearance:
    """Signed distance to the body [m] and the direction away from it.

    The direction is the body's smooth normal at the closest point, which doesn't
    flip for points inside.
    """
    vertices, faces = np.asarray(body.vertices), np.asarray(body.faces)
    count = len(points)
    # Padded to a multiple, so that meshes of similar size share a compiled program.
    pick = np.minimum(np.arange(-(-count // _ROWS) * _ROWS), count - 1)
    near = nearby_faces(vertices, faces, np.asarray(points))
    p = jnp.asarray(np.asarray(points)[pick], jnp.float32)
    hit = closest_among(body, p, jax.device_put(near[pick]))
    distance = np.asarray(signed_distance(body, p, closest=hit))[:count]
    normals = vertex_normals(np.asarray(body.vertices), np.asarray(body.faces))
    tri = faces[np.asarray(hit.face)[:count]]
    away = np.einsum("pk,pkc->pc", np.asarray(hit.weights)[:count], normals[tri])
    away /= np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-9)
    return distance, away


def set_clearance(
    body: TriMesh,
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    target: Float[np.ndarray, " vertices"],
    *,
    free: Float[np.ndarray, " vertices"] | None = None,
    iterations: int = 12,
    known: Clearance | None = None,
) -> Float[np.ndarray, "vertices 3"]:
    """Moves a garment to a target distance from the skin while keeping it smooth.

    Each pass moves vertices along the skin's normal and smooths the displacement
    over the mesh, so that wrinkles of the body don't show in the cloth.

    Args:
        body: Closed body mesh.
        vertices: Garment vertices [m].
        faces: Garment triangles.
        target: Target distance [m].
        free: 1 where the garment may be farther away (it hangs), 0 where it is held
            at the target.
        iterations: Passes.
        known: `clearance` of the vertices, if it is known.

    Returns:
        New positions [m].
    """
    v = np.asarray(vertices, dtype=np.float64).copy()
    loose = np.zeros(len(v)) if free is None else free
    average = smoothing_matrix(faces, len(v))
    distance, away = (x.copy() for x in (known or clearance(body, v)))
    # What hangs far from the skin never comes near it.
    near = np.flatnonzero((loose < 1) | (distance < target + _NEAR))
    for step in range(iterations):
        if step:
            distance[near], away[near] = clearance(body, v[near])
        missing = target - distance
        missing = np.where(missing < 0, missing * (1 - loose), missing)
        move = missing[:, None] * away
        for _ in range(3 if step < iterations - 3 else 0):
            move = average @ move
        v += move
    return v


def lift_out(
    body: TriMesh,
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    nearest: float,
    *,
    iterations: int = 8,
    known: Clearance | None = None,
) -> tuple[Float[np.ndarray, "vertices 3"], Bool[np.ndarray, " vertices"]]:
    """Moves a garment out of the skin to a minimum distance.

    Vertices at three times that distance or more stay bitwise unchanged.

    Args:
        body: Closed body mesh.
        vertices: Garment vertices [m].
        faces: Garment triangles.
        nearest: Minimum distance [m].
        iterations: Passes of `set_clearance`.
        known: `clearance` of the vertices, if it is known.

    Returns:
        New positions [m], and which vertices were closer than the minimum.
    """
    known = known or clearance(body, vertices)
    distance, _ = known
    low = distance < nearest
    if not low.any():
        return vertices, low
    if len(vertices) > FINE_MESH:
        vertices, known = _lifted_at_sites(body, vertices, faces, nearest, iterations, known)
        iterations = _LAST
    moved = _lifted(body, vertices, faces, nearest, iterations, known)
    return np.where((distance < 3 * nearest)[:, None], moved, vertices), low


def _lifted(
    body: TriMesh,
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    nearest: float,
    iterations: int,
    known: Clearance | None = None,
) -> Float[np.ndarray, "vertices 3"]:
    count = len(vertices)
    return set_clearance(
        body,
        vertices,
        faces,
        np.full(count, nearest),
        free=np.ones(count),
        iterations=iterations,
        known=known,
    )


def _lifted_at_sites(
    body: TriMesh,
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    nearest: float,
    iterations: int,
    known: Clearance,
) -> tuple[Float[np.ndarray, "vertices 3"], Clearance]:
    """A fine mesh lifted by what lifts a coarse one, and its clearance there.

    What is 1.5 distances from the skin or more stays.
    """
    rows, coarse, label = coarse_mesh(vertices, faces, NUM_SITES)
    at = vertices[rows]
    moved = _lifted(body, at, coarse, nearest, iterations, (known[0][rows], known[1][rows]))
    near, weight = linear_weights(vertices, faces, rows, label)
    change = np.einsum("vk,vkc->vc", weight, (moved - at)[near])
    lifted = vertices + np.where((known[0] < 1.5 * nearest)[:, None], change, 0.0)
    return lifted, clearance(body, lifted)


def bridge_hollows(
    body: TriMesh,
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    *,
    farthest: float,
    iterations: int = 40,
) -> Float[np.ndarray, "vertices 3"]:
    """Makes cloth span hollows of the body, as a taut membrane does.

    Vertices move towards their neighbours' mean where that leads outwards.

    Args:
        body: Closed body mesh.
        vertices: Garment vertices [m].
        faces: Garment triangles.
        farthest: No vertex moves beyond this distance from the skin [m].
        iterations: Passes.

    Returns:
        New positions [m].
    """
    v = np.asarray(vertices, dtype=np.float64).copy()
    average = smoothing_matrix(faces, len(v))
    edges = mesh_edges(faces)
    inner = np.ones(len(v))
    inner[np.unique(edges.vertices[edges.count == 1])] = 0.0
    for _ in range(iterations):
        distance, away = clearance(body, v)
        step = average @ v - v
        normals = vertex_normals(v, faces)
        outwards = np.maximum(np.einsum("vc,vc->v", step, normals), 0.0)
        # In deep folds the skin's normals cross: vertices move along the cloth's, by half.
        headroom = np.clip((farthest - distance) / 0.002, 0.0, 1.0)
        along = np.where((np.einsum("vc,vc->v", away, normals) > 0.0)[:, None], 1.0, 0.5)
        v += (inner * headroom * outwards)[:, None] * normals * along
    return v


def relax_crossings(
    body: TriMesh,
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    *,
    nearest: float = 0.006,
    rounds: int = 12,
) -> Float[np.ndarray, "vertices 3"]:
    """Smooths the cloth around self-intersections.

    Args:
        body: Closed body mesh.
        vertices: Garment vertices [m].
        faces: Garment triangles.
        nearest: Minimum distance of smoothed vertices from the skin [m].
        rounds: Largest number of attempts; each widens the smoothed region by one ring.

    Returns:
        New positions [m]; intersections may remain, see `self_intersections`.
    """
    v = np.asarray(vertices, dtype=np.float64).copy()
    average = smoothing_matrix(faces, len(v))
    edges = mesh_edges(faces).vertices
    for attempt in range(rounds):
        pairs = self_intersections(v, faces)
        if len(pairs) == 0:
            break
        region = np.zeros(len(v))
        region[edges[pairs[:, 0]].ravel()] = 1.0
        region[faces[pairs[:, 1]].ravel()] = 1.0
        for _ in range(2 + attempt):
            region = (average @ region > 0).astype(float)
        for _ in range(20):
            v += region[:, None] * (average @ v - v)
        for _ in range(4):
            deficit = np.maximum(nearest - clearance(body, v)[0], 0.0) * (region > 0)
            v += deficit[:, None] * vertex_normals(v, faces)
    return v


def lift_over(
    under: TriMesh,
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    gap: float,
    *,
    passes: int = 30,
) -> Float[np.ndarray, "vertices 3"]:
    """Lifts a garment over another one, at rest.

    Vertices less than the gap above the inner garment, or up to 3 cm beneath it, move along
    its normals: smoothly in the first passes, exactly in the last ones. Vertices beyond its
    borders don't move.

    Args:
        under: The inner garment.
        vertices: Vertices of the outer garment [m].
        faces: Triangles of the outer garment.
        gap: Target height above the inner garment [m].
        passes: Number of passes; each corrects the remaining deficit.
    """
    v = np.asarray(vertices, np.float64).copy()
    average = smoothing_matrix(faces, len(v))
    skin, triangles = np.asarray(under.vertices, np.float64), np.asarray(under.faces)
    normals = vertex_normals(skin, triangles)
    for step in range(passes):
        hit = closest_points(under, jnp.asarray(v, jnp.float32))
        corners, share = triangles[np.asarray(hit.face)], np.asarray(hit.weights, np.float64)
        closest_point = np.einsum("pk,pkc->pc", share, skin[corners])
        up = np.einsum("pk,pkc->pc", share, normals[corners])
        up /= np.maximum(np.linalg.norm(up, axis=1, keepdims=True), 1e-9)
        height = np.einsum("pc,pc->p", v - closest_point, up)
        lateral = np.linalg.norm(v - closest_point - height[:, None] * up, axis=1)
        deficit = np.where((lateral < 2e-3) & (height > -0.03), np.maximum(gap - height, 0.0), 0.0)
        if step < passes - 6:
            near = (height < 0.03) & (lateral < 0.01)
            deficit = np.where(near, 1.5 * (average @ (average @ deficit)), 0.0)
        v += deficit[:, None] * up
    return v


def level_hem(
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    height: float,
    *,
    reach: float = 0.09,
) -> Float[np.ndarray, "vertices 3"]:
    """Lowers the lowest border of a garment to at most a given height.

    The mesh above follows. Its displacement is a harmonic function on the mesh that falls to
    zero over ``reach``.

    Args:
        vertices: Garment vertices [m].
        faces: Garment triangles.
        height: Largest height of the border [m].
        reach: Distance along the mesh from the border up to which vertices move [m].
    """
    loop = min(boundary_loops(faces), key=lambda rows: vertices[rows, 1].mean())
    drop = np.minimum(height - vertices[loop, 1], 0.0)
    if not (drop < 0).any():
        return vertices
    a, b = mesh_edges(faces).vertices.T
    length = np.linalg.norm(vertices[a] - vertices[b], axis=1)
    count = len(vertices)
    pairs = (np.concatenate([a, b]), np.concatenate([b, a]))
    graph = sp.coo_matrix((np.tile(length, 2), pairs), (count, count)).tocsr()
    far = dijkstra(graph, indices=loop[drop < 0], min_only=True) > reach
    held = np.union1d(np.flatnonzero(far), loop)
    free = np.setdiff1d(np.arange(count), held)
    value = np.zeros(count)
    value[loop] = drop
    ties = sp.coo_matrix((np.tile(1.0 / length, 2), pairs), (count, count)).tocsr()
    laplacian = (sp.diags(np.asarray(ties.sum(axis=1)).ravel()) - ties).tocsr()
    inner = laplacian[free][:, free].tocsc()
    value[free] = np.asarray(spsolve(inner, -(laplacian[free][:, held] @ value[held])))
    return vertices + value[:, None] * np.array([0.0, 1.0, 0.0])
