"""A person's surface, sampled as points with normals."""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import KDTree

from ..errors import MeshError
from ..geometry import closest_among, make_mesh

# Sample points on the surface, four millimetres apart on an adult.
_POINTS = 40_000
# Cosine of the largest angle between normals that face the same way.
_FACING = 0.3


class Scan:
    """A person's surface, for queries of the nearest point that faces the same way.

    Args:
        vertices: Vertices of the mesh [m], shape [vertices, 3].
        faces: Triangles, shape [faces, 3].

    Attributes:
        points: Sample points, spread evenly over the surface [m], shape [points, 3].
        normals: Unit normals of the surface there, shape [points, 3].
        face: The faces that the points lie on, shape [points].

    Raises:
        MeshError: The mesh has no area.
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        self.vertices, self.faces = vertices, faces
        corners = vertices[faces]
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        area = np.linalg.norm(cross, axis=1)
        if not area.sum() > 0:
            raise MeshError("The person's mesh has no surface. Export it again.")
        rng = np.random.default_rng(0)
        count = _POINTS
        self.face = rng.choice(len(faces), count, p=area / area.sum())
        u = np.sqrt(rng.random((count, 1)))
        v = rng.random((count, 1))
        bary = np.concatenate([1 - u, u * (1 - v), u * v], axis=1)
        self.points = np.einsum("nk,nkc->nc", bary, corners[self.face])
        self.normals = cross[self.face] / np.maximum(area[self.face], 1e-30)[:, None]
        self.tree = KDTree(self.points)

    def nearest(
        self, points: np.ndarray, normals: np.ndarray, neighbours: int = 12
    ) -> tuple[np.ndarray, np.ndarray]:
        """Row of the nearest sample that faces the same way, and its distance [m]."""
        return nearest_facing(self.tree, self.normals, points, normals, neighbours)

    def closest_facing(
        self, points: np.ndarray, normals: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Closest points on faces that face the same way: face, weights, distance [m]."""
        row = np.asarray(self.tree.query(points, k=32)[1])
        facing = np.einsum("nkc,nc->nk", self.normals[row], normals) > _FACING
        first = np.where(facing.any(axis=1), facing.argmax(axis=1), 0)
        face = self.face[row]
        fallback = np.take_along_axis(face, first[:, None], axis=1)
        face = np.where(facing, face, fallback).astype(np.int32)
        mesh = make_mesh(self.vertices.astype(np.float32), self.faces)
        found = closest_among(mesh, jnp.asarray(points, jnp.float32), jax.device_put(face))
        distance = np.sqrt(np.asarray(found.squared_distance))
        distance = np.where(facing.any(axis=1), distance, np.inf)
        return np.asarray(found.face), np.asarray(found.weights), distance


def nearest_facing(
    tree: KDTree,
    tree_normals: np.ndarray,
    points: np.ndarray,
    normals: np.ndarray,
    neighbours: int = 12,
) -> tuple[np.ndarray, np.ndarray]:
    """Finds the nearest row of a tree that faces the same way as each query point.

    Args:
        tree: Points to search [m].
        tree_normals: Their unit normals.
        points: Query points [m].
        normals: Their unit normals.
        neighbours: Number of nearest rows to consider.

    Returns:
        The rows and their distances [m], infinite if no row faces the same way.
    """
    distance, row = map(np.asarray, tree.query(points, k=neighbours))
    facing = np.einsum("nkc,nc->nk", tree_normals[row], normals) > _FACING
    first = np.where(facing.any(axis=1), facing.argmax(axis=1), 0)
    pick = np.arange(len(points))
    return row[pick, first], np.where(facing.any(axis=1), distance[pick, first], np.inf)
