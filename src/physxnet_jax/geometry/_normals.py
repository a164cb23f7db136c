"""Face and vertex normals that stay finite on degenerate triangles."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ._rotation import safe_normalize


def face_normals(
    vertices: Float[Array, "*batch vertices 3"], faces: Int[Array, "faces 3"]
) -> Float[Array, "*batch faces 3"]:
    """Unit normals of triangles; zero where a triangle has no area.

    Args:
        vertices: Positions [m].
        faces: Triangles.

    Returns:
        Unit normals, counter-clockwise side outwards.
    """
    a, b, c = (vertices[..., faces[:, i], :] for i in range(3))
    return safe_normalize(jnp.cross(b - a, c - a))


@jax.jit
def vertex_normals(
    vertices: Float[Array, "*batch vertices 3"], faces: Int[Array, "faces 3"]
) -> Float[Array, "*batch vertices 3"]:
    """Angle-weighted unit normals of vertices.

    They give the correct sign of the distance to a closed mesh where the closest feature
    is a vertex.

    Args:
        vertices: Positions [m].
        faces: Triangles.

    Returns:
        Unit normals; zero at vertices without area around them.

    References:
        Baerentzen and Aanaes, Signed distance computation using the angle weighted
        pseudonormal (2005).
    """
    corners = [vertices[..., faces[:, i], :] for i in range(3)]
    normal = face_normals(vertices, faces)
    out = jnp.zeros_like(vertices)
    for i in range(3):
        u = safe_normalize(corners[(i + 1) % 3] - corners[i])
        w = safe_normalize(corners[(i + 2) % 3] - corners[i])
        # Half-angle form: acos would have an infinite slope on slivers.
        angle = 2.0 * jnp.arctan2(_length(u - w), jnp.maximum(_length(u + w), 1e-6))
        out = out.at[..., faces[:, i], :].add(angle[..., None] * normal)
    return safe_normalize(out)


def _length(v: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
    return jnp.sqrt(jnp.sum(v * v, axis=-1) + 1e-20)
