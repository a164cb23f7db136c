"""Garments modelled on another body: transferred to the built-in one by registering it."""

import functools
import pathlib

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from ..body import (
    NUM_BODY_VERTICES,
    Body,
    Registration,
    load_body,
    register_body,
    unit_of_person,
)
from ..errors import MeshError
from ..geometry import boundary_loops
from ..io import StaticMesh, read_mesh
from ._locate import Placement
from ._openings import openings
from ._poses import posed_bodies
from ._search import UNITS

# Skin vertices that carry a garment vertex, and the width of their weights [m].
_CARRIERS, _WIDTH = 32, 0.03
# Skin vertices whose rotation is fitted together.
_AROUND = 24
# Cloth farther from the skin than this is carried by skin as far apart [m].
_FAR = 0.5


def placed_by_body(
    path: str | pathlib.Path, mesh: StaticMesh, made_on: str | pathlib.Path, body: Body
) -> Placement:
    """Puts a garment on the body as it lay on the body that it was made on.

    The other body is registered (`register_body`); cloth keeps its distance from the skin
    beneath it and turns with it, so that unit, pose, proportions and origin don't matter.

    Args:
        path: The garment's file, for error messages.
        mesh: The garment in its file's unit and axes.
        made_on: A mesh of the other body, in the same place.
        body: The body.

    Raises:
        MeshError: The mesh is no person, or lies elsewhere than the garment.
        FormatError: Its file can't be read.
    """
    other = read_mesh(made_on)
    extent = np.ptp(other.vertices, axis=0)
    up = other.up or ("Z" if extent[2] > extent[1] else "Y")
    height = float(extent["XYZ".index(up[-1])])
    unit = unit_of_person(height)
    if unit is None or up not in ("Y", "Z"):
        raise MeshError(
            f"{made_on}: its height is {height:.3g}, which is no person's in {', '.join(UNITS)}:"
            " name a mesh of the whole body."
        )
    theirs = _in_metres(other.vertices, UNITS[unit], up)
    own_unit, own_up = mesh.unit or unit, mesh.up or up
    points = _in_metres(mesh.vertices, UNITS[own_unit], own_up)
    found = _registered(theirs.tobytes(), np.ascontiguousarray(other.faces, np.int32).tobytes())
    gap = KDTree(found.posed).query(points)[0]
    if np.median(gap) > _FAR:
        raise MeshError(
            f"{path}: lies {np.median(gap):.2f} m away from {made_on}. Export both from one scene."
        )
    rest = np.asarray(body.rest_vertices(body.default_shape()), np.float64)[:NUM_BODY_VERTICES]
    moved = _carry(points, np.asarray(found.posed, np.float64), rest)
    notes = (f"made on {pathlib.Path(made_on).name}: carried to the built-in body with its skin.",)
    pose = posed_bodies(body)["rest"]
    return Placement(
        moved,
        own_unit,
        own_up,
        "rest",
        notes,
        tuple(openings(moved, boundary_loops(mesh.faces), pose.limbs)),
    )


def _in_metres(
    vertices: Float[np.ndarray, "points 3"], scale: float, up: str
) -> Float[np.ndarray, "points 3"]:
    x = np.asarray(vertices, np.float64) * scale
    return np.ascontiguousarray(x if up == "Y" else x[:, [0, 2, 1]] * [1.0, 1.0, -1.0])


@functools.lru_cache(maxsize=4)
def _registered(vertices: bytes, faces: bytes) -> Registration:
    """Registration takes seconds; an outfit's garments were made on one body."""
    x = np.frombuffer(vertices, np.float64).reshape(-1, 3)
    return register_body(x, np.frombuffer(faces, np.int32).reshape(-1, 3), body=load_body())


def _carry(
    points: Float[np.ndarray, "points 3"],
    source: Float[np.ndarray, "skin 3"],
    target: Float[np.ndarray, "skin 3"],
) -> Float[np.ndarray, "points 3"]:
    """Moves points with the skin around them, each skin vertex rigidly with its neighbours."""
    tree = KDTree(source)
    distance, near = map(np.asarray, tree.query(points, k=_CARRIERS))
    width = _WIDTH + 0.5 * distance[:, :1]
    weight = np.exp(-0.5 * ((distance - distance[:, :1]) / width) ** 2)
    weight /= weight.sum(axis=1, keepdims=True)
    used, local = np.unique(near, return_inverse=True)
    turns = _rotations(source, target, used)
    offset = points[:, None] - source[near]
    turned = np.einsum("pkab,pkb->pka", turns[local.reshape(near.shape)], offset)
    return np.einsum("pk,pkc->pc", weight, target[near] + turned)


def _rotations(
    source: Float[np.ndarray, "skin 3"],
    target: Float[np.ndarray, "skin 3"],
    rows: Int[np.ndarray, " rows"],
) -> Float[np.ndarray, "rows 3 3"]:
    """The rotation of the skin around each of some vertices (Kabsch's algorithm)."""
    around = np.asarray(KDTree(target).query(target[rows], k=_AROUND)[1])
    a, b = (x[around] - x[around].mean(axis=1, keepdims=True) for x in (source, target))
    u, _, v = np.linalg.svd(np.einsum("rka,rkb->rab", a, b))
    sign = np.linalg.det(np.swapaxes(v, 1, 2) @ np.swapaxes(u, 1, 2))
    fix = np.ones((len(rows), 3))
    fix[:, 2] = sign
    return np.swapaxes(v, 1, 2) @ (fix[..., None] * np.swapaxes(u, 1, 2))
