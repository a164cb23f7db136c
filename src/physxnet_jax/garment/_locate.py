"""Locates a garment mesh on the body: its unit, up axis and pose."""

import functools
import pathlib
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.spatial import KDTree

from ..body import NUM_BODY_VERTICES, Body, load_body, t_pose
from ..errors import MeshError
from ..geometry import (
    TriMesh,
    closest_among,
    nearby_faces,
    padded_rows,
    smoothing_matrix,
    vertex_normals,
)
from ._garment import carried_weights

UNITS = {"m": 1.0, "dm": 0.1, "cm": 0.01, "inch": 0.0254, "mm": 0.001}
# A garment stands on the floor if its misfit there is below this share of that at the origin [1].
_FLOOR_RATIO = 0.6
# Misfit up to which other poses aren't tried, and above which a garment is misplaced [m]; share
# of the rest-pose misfit below which a T-pose is accepted [1].
_GOOD_FIT, _MAX_MISFIT, _T_POSE_RATIO = 0.015, 0.12, 0.75
# Distance from the skin within which a cape is held [m].
_CONTACT_DISTANCE = 0.03


class Placement(NamedTuple):
    """A garment's mesh on the body at rest.

    Attributes:
        vertices: Positions [m], shape [vertices, 3].
        unit: The unit of its file.
        up: The up axis.
        posed: Whether it was modelled in a T-pose and moved to the rest pose.
    """

    vertices: Float[np.ndarray, "vertices 3"]
    unit: str
    up: str
    posed: bool = False


def locate_on_body(
    path: pathlib.Path,
    vertices: Float[np.ndarray, "vertices 3"],
    body: Body,
    faces: Int[np.ndarray, "faces 3"],
) -> Placement:
    """Converts a mesh to metres with the unit, axis and pose that bring it closest to the skin.

    A mesh that lies closer to the body in a T-pose is moved to the rest pose with the skin
    beneath it.

    Args:
        path: File name for the error message.
        vertices: Vertices in the file's unit and axes.
        body: The body.
        faces: Triangles of the mesh.

    Raises:
        MeshError: No unit and up axis places the mesh on the body.
    """
    score, v, unit, up = _best_placement(vertices, body.rest_mesh())
    # A good fit needn't be compared with other poses.
    if score > _GOOD_FIT:
        pose = _cached_t_pose(body)
        other = _best_placement(vertices, pose.skin)
        if other[0] < _T_POSE_RATIO * score:
            score, v, unit, up = other
            if score <= _MAX_MISFIT:
                return Placement(_to_rest_pose(v, faces, body, pose), unit, up, True)
    if score > _MAX_MISFIT and _hangs_free(vertices, body.rest_mesh()):
        return Placement(np.asarray(vertices, np.float64), "m", "Y")
    if score > _MAX_MISFIT:
        size = np.ptp(vertices, axis=0)
        raise MeshError(
            f"{path}: no unit and up axis puts this mesh on the body: it measures"
            f" {size[0]:.3g} x {size[1]:.3g} x {size[2]:.3g} and is"
            f" {score:.2f} m away on average. Scale and move it with physxnet fit"
            f" {path} --like top (or bottom, dress), or place it on the body at rest, which"
            " physxnet export-rest writes (A-pose, Y up, origin in the pelvis), and export again."
        )
    return Placement(v, unit, up)


def _hangs_free(vertices: Float[np.ndarray, "vertices 3"], mesh: TriMesh) -> bool:
    """Whether a mesh in metres is held close to the body, as a cape, and hangs free elsewhere."""
    if not 0.1 < np.ptp(vertices, axis=0).max() < 2.5:
        return False
    points = np.asarray(mesh.vertices)
    normals = np.asarray(vertex_normals(mesh.vertices, mesh.faces))
    distance, nearest = KDTree(points).query(vertices)
    out = np.einsum("vc,vc->v", vertices - points[nearest], normals[nearest])
    return bool(np.quantile(distance, 0.05) < _CONTACT_DISTANCE and np.mean(out < 0) < 0.05)


def _best_placement(
    vertices: Float[np.ndarray, "vertices 3"], mesh: TriMesh
) -> tuple[float, Float[np.ndarray, "vertices 3"], str, str]:
    """The smallest misfit [m], the positions there [m], and the unit and up axis."""
    skin = np.asarray(mesh.vertices)
    misfit = skin_misfit(mesh)
    floor = np.array([0.0, float(skin[:, 1].min()), 0.0])
    best = (np.inf, vertices, "m", "Y")
    for up in ("Y", "Z"):
        turned = vertices if up == "Y" else vertices[:, [0, 2, 1]] * [1.0, 1.0, -1.0]
        for unit, scale in UNITS.items():
            if not 0.1 < np.ptp(turned * scale, axis=0).max() < 2.5:
                continue
            unmoved = np.inf
            for shift in (np.zeros(3), floor):
                v = turned * scale + shift
                # A garment scaled by too small a unit is close to the skin, but inside it.
                score = misfit(v, 0.015)
                # Legs are close to any misplaced mesh around them, so the floor has to fit
                # far better than the origin.
                if shift.any() and score > _FLOOR_RATIO * unmoved:
                    continue
                unmoved = score
                if score < best[0] - 1e-9:
                    best = (score, v, unit, up)
    return best


def skin_misfit(skin: TriMesh) -> Callable[[Float[np.ndarray, "vertices 3"], float], float]:
    """Returns a function of vertices and a depth [m] that measures their misfit to the body [m].

    The misfit is the mean distance from the skin plus 0.2 times the share of vertices deeper
    than the given depth.
    """
    points = np.asarray(skin.vertices)
    normals = np.asarray(vertex_normals(skin.vertices, skin.faces))
    tree = KDTree(points)

    def misfit(vertices: Float[np.ndarray, "vertices 3"], depth_limit: float) -> float:
        distance, nearest = tree.query(vertices)
        depth = np.einsum("ij,ij->i", points[nearest] - vertices, normals[nearest])
        return float(np.mean(distance)) + 0.2 * float(np.mean(depth > depth_limit))

    return misfit


class _Pose(NamedTuple):
    """The skin of a posed body, and the transforms of its joints."""

    skin: TriMesh
    rotations: Float[np.ndarray, "joints 3 3"]
    translations: Float[np.ndarray, "joints 3"]


def _cached_t_pose(body: Body) -> _Pose:
    return _builtin_t_pose() if body is load_body() else _compute_t_pose(body)


@functools.cache
def _builtin_t_pose() -> _Pose:
    return _compute_t_pose(load_body())


def _compute_t_pose(body: Body) -> _Pose:
    rest = body.rest_vertices(body.default_shape())
    root = body.joint_positions(rest)[0][0]
    r, t = (np.asarray(x, np.float64) for x in body.transforms(rest, t_pose(body), root))
    weights = np.asarray(body.weights)[:NUM_BODY_VERTICES]
    x = np.asarray(rest, np.float64)[:NUM_BODY_VERTICES]
    moved = np.einsum("vab,vb->va", np.einsum("vj,jab->vab", weights, r), x) + weights @ t
    mesh = body.rest_mesh()
    return _Pose(mesh.replace(vertices=jnp.asarray(moved, jnp.float32)), r, t)


def _to_rest_pose(
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    body: Body,
    pose: _Pose,
) -> Float[np.ndarray, "vertices 3"]:
    """Moves cloth on a posed body to the rest pose by inverting the skinning beneath it [m]."""
    weights = nearest_skin(pose.skin, body, vertices, faces)[2].astype(np.float64)
    blend = np.einsum("vj,jab->vab", weights, pose.rotations)
    return np.linalg.solve(blend, (vertices - weights @ pose.translations)[..., None])[..., 0]


def nearest_skin(
    skin: TriMesh,
    body: Body,
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
) -> tuple[
    Int[Array, "vertices 3"], Float[Array, "vertices 3"], Float[np.ndarray, "vertices joints"]
]:
    """Closest skin of each vertex: corners of the face, barycentric and skinning weights.

    Far from the skin, skinning weights are smoothed, so that a skirt isn't torn between the
    legs.

    Args:
        skin: The body's skin in some pose.
        body: The body.
        vertices: Vertices of the mesh [m].
        faces: Triangles of the mesh.
    """
    near = nearby_faces(np.asarray(skin.vertices), np.asarray(skin.faces), vertices, neighbours=12)
    points = padded_rows(vertices.astype(np.float32))
    hit = jax.jit(closest_among)(skin, jnp.asarray(points), jnp.asarray(padded_rows(near)))
    refs = skin.faces[hit.face]
    skin_weights = carried_weights(body.weights, refs, hit.weights)
    known = (refs, hit.weights, skin_weights, hit.squared_distance)
    refs, shares, weights, squared = (np.asarray(x)[: len(vertices)] for x in known)
    return jnp.asarray(refs), jnp.asarray(shares), _smooth_far(weights, faces, np.sqrt(squared))


def _smooth_far(weights: np.ndarray, faces: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Smooths skinning weights over the mesh where the skin is far away."""
    average = smoothing_matrix(faces, len(weights))
    share = np.clip((distance - 0.02) / 0.04, 0.0, 1.0)[:, None]
    for _ in range(60):
        weights = weights + share * (average @ weights - weights)
    return weights / weights.sum(axis=1, keepdims=True)
