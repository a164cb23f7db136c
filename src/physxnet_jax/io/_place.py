"""Where a garment's mesh lies on the body: its unit, its up axis, its pose."""

import functools
import pathlib
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.spatial import KDTree

from ..body import NUM_BODY_VERTICES, Body, load_body
from ..errors import MeshError
from ..garment import carried_weights, smoothing_matrix
from ..geometry import TriMesh, closest_among, nearby_faces, padded_rows, vertex_normals

UNITS = {"m": 1.0, "dm": 0.1, "cm": 0.01, "inch": 0.0254, "mm": 0.001}
# How much better a garment that stands on the floor fits there than about the origin [1].
_CLEARLY = 0.6
# Misfits: of what is as it should be, of what is elsewhere [m]; and how much better a garment
# that was made for a T-pose fits there [1].
_WELL, _FARTHEST, _POSED = 0.015, 0.12, 0.75
# So near to the skin is what holds a cape [m].
_TOUCHES = 0.03


class Placement(NamedTuple):
    """A garment's mesh on the body at rest.

    Attributes:
        vertices: Where it lies [m], shape [vertices, 3].
        unit: The unit of its file.
        up: The up axis.
        posed: Whether it was made for a T-pose, and was brought to the rest pose.
    """

    vertices: Float[np.ndarray, "vertices 3"]
    unit: str
    up: str
    posed: bool = False


def place_on_body(
    path: pathlib.Path,
    vertices: Float[np.ndarray, "vertices 3"],
    body: Body,
    faces: Int[np.ndarray, "faces 3"],
) -> Placement:
    """The mesh in metres, by the unit, axis and pose that bring it closest to the skin.

    What lies closer to the body in a T-pose is brought to the rest pose as the skin beneath
    it is.

    Args:
        path: Named in the error.
        vertices: In the file's unit and axes.
        body: The body.
        faces: Its triangles.

    Raises:
        MeshError: None does.
    """
    score, v, unit, up = _best_place(vertices, body.rest_mesh())
    # What fits well needn't be compared with other poses.
    if score > _WELL:
        pose = _t_posed(body)
        other = _best_place(vertices, pose.skin)
        if other[0] < _POSED * score:
            score, v, unit, up = other
            if score <= _FARTHEST:
                return Placement(_unposed(v, faces, body, pose), unit, up, True)
    if score > _FARTHEST and _hangs_free(vertices, body.rest_mesh()):
        return Placement(np.asarray(vertices, np.float64), "m", "Y")
    if score > _FARTHEST:
        size = np.ptp(vertices, axis=0)
        raise MeshError(
            f"{path}: no unit and up axis puts this mesh on the body: it measures"
            f" {size[0]:.3g} x {size[1]:.3g} x {size[2]:.3g} and stays"
            f" {score:.2f} m away on average. Have it scaled and moved (physxnet fit"
            f" {path} --like top, bottom or dress), or move it onto the body at rest, which"
            " physxnet rest writes (A-pose, Y up, origin in the pelvis), and export again."
        )
    return Placement(v, unit, up)


def _hangs_free(vertices: Float[np.ndarray, "vertices 3"], mesh: TriMesh) -> bool:
    """Whether a mesh in metres hangs from the body, as a cape does, far from it elsewhere."""
    if not 0.1 < np.ptp(vertices, axis=0).max() < 2.5:
        return False
    points = np.asarray(mesh.vertices)
    normals = np.asarray(vertex_normals(mesh.vertices, mesh.faces))
    distance, nearest = KDTree(points).query(vertices)
    out = np.einsum("vc,vc->v", vertices - points[nearest], normals[nearest])
    return bool(np.quantile(distance, 0.05) < _TOUCHES and np.mean(out < 0) < 0.05)


def _best_place(
    vertices: Float[np.ndarray, "vertices 3"], mesh: TriMesh
) -> tuple[float, Float[np.ndarray, "vertices 3"], str, str]:
    """How badly the mesh fits at its best [m], where that is [m], and in which unit and axis."""
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
                # A garment too small by a unit lies close to the skin, but within it.
                score = misfit(v, 0.015)
                # Legs are near whatever hangs askew about them: what stands on the floor
                # fits far better there than about the origin.
                if shift.any() and score > _CLEARLY * unmoved:
                    continue
                unmoved = score
                if score < best[0] - 1e-9:
                    best = (score, v, unit, up)
    return best


def skin_misfit(skin: TriMesh) -> Callable[[Float[np.ndarray, "vertices 3"], float], float]:
    """How badly vertices fit the body [m]: their mean distance, and how many lie deeper than so."""
    points = np.asarray(skin.vertices)
    normals = np.asarray(vertex_normals(skin.vertices, skin.faces))
    tree = KDTree(points)

    def misfit(vertices: Float[np.ndarray, "vertices 3"], deep: float) -> float:
        distance, nearest = tree.query(vertices)
        depth = np.einsum("ij,ij->i", points[nearest] - vertices, normals[nearest])
        return float(np.mean(distance)) + 0.2 * float(np.mean(depth > deep))

    return misfit


class _Pose(NamedTuple):
    """The body in a pose, and how its joints were moved there."""

    skin: TriMesh
    rotations: Float[np.ndarray, "joints 3 3"]
    translations: Float[np.ndarray, "joints 3"]


def _t_posed(body: Body) -> _Pose:
    return _usual_t_pose() if body is load_body() else _made_t_pose(body)


@functools.cache
def _usual_t_pose() -> _Pose:
    return _made_t_pose(load_body())


def _made_t_pose(body: Body) -> _Pose:
    rest = body.rest_vertices(body.default_shape())
    root = body.joint_positions(rest)[0][0]
    r, t = (np.asarray(x, np.float64) for x in body.transforms(rest, body.t_pose(), root))
    weights = np.asarray(body.weights)[:NUM_BODY_VERTICES]
    x = np.asarray(rest, np.float64)[:NUM_BODY_VERTICES]
    moved = np.einsum("vab,vb->va", np.einsum("vj,jab->vab", weights, r), x) + weights @ t
    mesh = body.rest_mesh()
    return _Pose(mesh.replace(vertices=jnp.asarray(moved, jnp.float32)), r, t)


def _unposed(
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    body: Body,
    pose: _Pose,
) -> Float[np.ndarray, "vertices 3"]:
    """Cloth on a posed body [m], brought to the rest pose by the skin that it lies on."""
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
    """The skin closest to a mesh: its vertices, their shares, and skinning weights there.

    Far from the skin weights are smoothed, so that a skirt isn't torn between the legs.

    Args:
        skin: The body's skin in some pose.
        body: The body.
        vertices: The mesh [m].
        faces: Its triangles.
    """
    near = nearby_faces(np.asarray(skin.vertices), np.asarray(skin.faces), vertices, neighbours=12)
    points = padded_rows(vertices.astype(np.float32))
    hit = jax.jit(closest_among)(skin, jnp.asarray(points), jnp.asarray(padded_rows(near)))
    refs = skin.faces[hit.face]
    carried = carried_weights(body.weights, refs, hit.weights)
    known = (refs, hit.weights, carried, hit.squared_distance)
    refs, shares, weights, squared = (np.asarray(x)[: len(vertices)] for x in known)
    return jnp.asarray(refs), jnp.asarray(shares), _smooth_far(weights, faces, np.sqrt(squared))


def _smooth_far(weights: np.ndarray, faces: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Skinning weights averaged over the mesh where the skin is far away."""
    average = smoothing_matrix(faces, len(weights))
    share = np.clip((distance - 0.02) / 0.04, 0.0, 1.0)[:, None]
    for _ in range(60):
        weights = weights + share * (average @ weights - weights)
    return weights / weights.sum(axis=1, keepdims=True)
