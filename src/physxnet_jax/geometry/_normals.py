"""Face and vertex normals that stay finite on degenerate triangles."""

from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ._rotation import safe_normalize

_A = TypeVar("_A", Array, np.ndarray)


def face_normals(
    vertices: Float[_A, "*batch vertices 3"], faces: Int[_A, "faces 3"]
) -> Float[_A, "*batch faces 3"]:
    """Unit normals of triangles; zero where a triangle has no area.

    Args:
        vertices: Positions [m].
        faces: Triangles.

    Returns:
        Unit normals, counter-clockwise side outwards. NumPy arrays give NumPy arrays.
    """
    xp: Any = np if isinstance(vertices, np.ndarray) else jnp
    a, b, c = (vertices[..., faces[:, i], :] for i in range(3))
    return safe_normalize(xp.cross(b - a, c - a))


def vertex_normals(
    vertices: Float[_A, "*batch vertices 3"], faces: Int[_A, "faces 3"]
) -> Float[_A, "*batch vertices 3"]:
    """Angle-weighted unit normals of vertices.

    They give the correct sign of the distance to a closed mesh where the closest feature
    is a vertex.

    Args:
        vertices: Positions [m].
        faces: Triangles.

    Returns:
        Unit normals; zero at vertices without area around them. NumPy arrays give NumPy arrays,
        with nothing compiled.

    References:
        Baerentzen and Aanaes, Signed distance computation using the angle weighted
        pseudonormal (2005).
    """
    if isinstance(vertices, np.ndarray):
        return _on_host(vertices, np.asarray(faces))
    return _compiled(vertices, faces)


@jax.jit
def _compiled(vertices: Array, faces: Array) -> Array:
    out = jnp.zeros_like(vertices)
    for i, share in enumerate(_shares(vertices, faces)):
        out = out.at[..., faces[:, i], :].add(share)
    return safe_normalize(out)


def _on_host(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    shares = np.stack(_shares(vertices, faces), axis=-2)
    flat = shares.reshape(-1, 3 * len(faces), 3)
    count = vertices.shape[-2]
    sums = [
        [np.bincount(faces.ravel(), one[:, k], minlength=count) for k in range(3)] for one in flat
    ]
    out = np.moveaxis(np.reshape(sums, (-1, 3, count)), 1, 2).reshape(vertices.shape)
    return safe_normalize(out.astype(vertices.dtype))


def _shares(vertices: Any, faces: Any) -> list[Any]:
    """What each corner's vertex gets: the triangle's normal, times the angle at that corner."""
    xp: Any = np if isinstance(vertices, np.ndarray) else jnp
    corners = [vertices[..., faces[:, i], :] for i in range(3)]
    normal = face_normals(vertices, faces)
    out = []
    for i in range(3):
        u = safe_normalize(corners[(i + 1) % 3] - corners[i])
        w = safe_normalize(corners[(i + 2) % 3] - corners[i])
        # Half-angle form: acos would have an infinite slope on slivers.
        angle = 2.0 * xp.arctan2(_length(u - w), xp.maximum(_length(u + w), 1e-6))
        out.append(angle[..., None] * normal)
    return out


def _length(v: Any) -> Any:
    xp: Any = np if isinstance(v, np.ndarray) else jnp
    return xp.sqrt(xp.sum(v * v, axis=-1) + 1e-20)
