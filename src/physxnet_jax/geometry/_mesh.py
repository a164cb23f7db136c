"""Triangle meshes as pytrees."""

import dataclasses

import jax
import numpy as np
from jaxtyping import Array, Float, Int

from ..errors import MeshError
from ..typing import pytree


@pytree
@dataclasses.dataclass(frozen=True)
class TriMesh:
    """A triangle mesh.

    Attributes:
        vertices: Vertex positions [m], shape [vertices, 3].
        faces: Vertex indices, counter-clockwise from outside, shape [faces, 3].
        uv: Texture coordinates [1], (0, 0) bottom left, shape [uvs, 2]; or None.
        uv_faces: Indices into ``uv`` of every corner, shape [faces, 3]; or None.
    """

    vertices: Float[Array, "vertices 3"]
    faces: Int[Array, "faces 3"]
    uv: Float[Array, "uvs 2"] | None = None
    uv_faces: Int[Array, "faces 3"] | None = None

    def replace(self, **changes: object) -> "TriMesh":
        """A copy with some attributes changed."""
        return dataclasses.replace(self, **changes)  # pyright: ignore[reportArgumentType]


def make_mesh(
    vertices: object,
    faces: object,
    uv: object | None = None,
    uv_faces: object | None = None,
    *,
    name: str = "mesh",
) -> TriMesh:
    """Builds a `TriMesh` from host arrays after checking them.

    Args:
        vertices: Positions [m], shape [vertices, 3].
        faces: Vertex indices, shape [faces, 3].
        uv: Texture coordinates, shape [uvs, 2].
        uv_faces: Corner indices into ``uv``; ``faces`` by default (one uv row per vertex).
        name: Name of the mesh in errors.

    Returns:
        The mesh, float32 and int32.

    Raises:
        MeshError: Wrong shapes, no triangle, indices out of range, NaN or infinity.

    Example:
        >>> mesh = make_mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
        >>> mesh.faces.shape
        (1, 3)
    """
    # A copy: arrays on a CPU may share memory with those that they were made from.
    v = np.array(vertices, dtype=np.float32)
    if not np.array_equal(np.asarray(faces, dtype=np.float64), np.asarray(faces, dtype=np.int64)):
        raise MeshError(f"{name}: face indices contain fractions, expected whole numbers.")
    f = np.asarray(faces, dtype=np.int64)
    if v.ndim != 2 or v.shape[1] != 3:
        raise MeshError(f"{name}: vertices have shape {v.shape}, expected [vertices, 3].")
    if f.ndim != 2 or f.shape[-1] != 3 or len(f) == 0:
        raise MeshError(
            f"{name}: faces have shape {f.shape}, expected [faces, 3] with at least one"
            " triangle. Triangulate polygons first."
        )
    if f.min() < 0 or f.max() >= len(v):
        raise MeshError(
            f"{name}: a face refers to vertex {f.min() if f.min() < 0 else f.max()}, but"
            f" there are {len(v)} vertices (0 to {len(v) - 1})."
        )
    if not np.isfinite(v).all():
        row = int(np.argwhere(~np.isfinite(v).all(axis=1))[0, 0])
        raise MeshError(f"{name}: vertex {row} is not finite ({v[row].tolist()}). Export it again.")
    if uv is None:
        return TriMesh(jax.device_put(v), jax.device_put(f.astype(np.int32)))
    t = np.array(uv, dtype=np.float32)
    tf = f if uv_faces is None else np.asarray(uv_faces, dtype=np.int64)
    if t.ndim != 2 or t.shape[1] != 2 or tf.shape != f.shape:
        raise MeshError(
            f"{name}: uv has shape {t.shape} and uv_faces {tf.shape}, expected"
            f" [uvs, 2] and {f.shape}."
        )
    if tf.min() < 0 or tf.max() >= len(t):
        raise MeshError(
            f"{name}: a corner refers to uv {tf.min() if tf.min() < 0 else tf.max()}, but there are"
            f" {len(t)} (0 to {len(t) - 1})."
        )
    if not np.isfinite(t).all():
        row = int(np.argwhere(~np.isfinite(t).all(axis=1))[0, 0])
        raise MeshError(f"{name}: uv {row} is not finite ({t[row].tolist()}). Export it again.")
    return TriMesh(
        jax.device_put(v),
        jax.device_put(f.astype(np.int32)),
        jax.device_put(t),
        jax.device_put(tf.astype(np.int32)),
    )
