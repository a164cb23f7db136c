"""Rasterising uv triangles: every covered texel belongs to exactly one face."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

_CHUNK = 512


def rasterise(
    uv: Float[np.ndarray, "uvs 2"],
    faces: Int[np.ndarray, "faces 3"],
    height: int,
    width: int,
) -> tuple[Int[np.ndarray, " texels"], Int[np.ndarray, " texels"], Float[np.ndarray, "texels 3"]]:
    """Texels whose centre lies in a triangle of the uv chart.

    Edge functions are evaluated from the lower to the higher vertex index, so both
    faces beside an edge use the same value and no texel between them is lost. A texel
    that several faces cover (a centre on an edge, an overlap) goes to the first one.
    Triangles without area cover nothing.

    Args:
        uv: Texture coordinates, (0, 0) bottom left.
        faces: Triangles over ``uv``.
        height: Rows of the map; row 0 is the top (v = 1).
        width: Columns of the map.

    Returns:
        Covered texels in row-major order as flat indices, their faces, and the
        barycentric coordinates of their centres.

    References:
        Pineda, A parallel algorithm for polygon rasterization (1988).
    """
    xy = np.column_stack([uv[:, 0] * width, (1.0 - uv[:, 1]) * height]) - 0.5
    corners = xy[faces]
    low = np.floor(corners.min(axis=1)).astype(np.int32)
    size = int((np.ceil(corners.max(axis=1)) - low).max()) + 1
    chunk = min(_CHUNK, len(faces))
    blocks = -(-len(faces) // chunk)
    pad = np.minimum(np.arange(blocks * chunk), len(faces) - 1)
    owner = _owners(
        jax.device_put(xy.astype(np.float32)),
        jax.device_put(np.asarray(faces, np.int32)[pad].reshape(blocks, chunk, 3)),
        jax.device_put(low[pad].reshape(blocks, chunk, 2)),
        jax.device_put(pad.astype(np.int32).reshape(blocks, chunk)),
        height,
        width,
        size,
        len(faces),
    )
    owner = np.asarray(owner)
    texels = np.flatnonzero(owner < len(faces)).astype(np.int32)
    face_of_texel = owner[texels].astype(np.int32)
    points = np.column_stack([texels % width, texels // width]).astype(np.float64)
    a, b, c = (xy[faces[face_of_texel, k]].astype(np.float64) for k in range(3))
    area = _cross(b - a, c - a)
    weights = np.column_stack(
        [
            _cross(b - points, c - points),
            _cross(c - points, a - points),
            _cross(a - points, b - points),
        ]
    )
    weights = np.clip(weights / area[:, None], 0.0, 1.0)
    return texels, face_of_texel, weights / weights.sum(axis=1, keepdims=True)


def _cross(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    return u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]


@functools.partial(jax.jit, static_argnums=(4, 5, 6, 7))
def _owners(
    xy: Array,
    faces: Array,
    low: Array,
    index: Array,
    height: int,
    width: int,
    size: int,
    no_face: int,
) -> Array:
    """First covering face of every texel; the number of faces where there is none."""
    square = np.meshgrid(np.arange(size), np.arange(size), indexing="xy")
    offsets = np.stack(square, axis=-1).reshape(-1, 2).astype(np.int32)

    def block(owner: Array, part: tuple[Array, Array, Array]) -> tuple[Array, None]:
        tri, corner, ids = part
        at = corner[:, None] + offsets[None]
        p = at.astype(xy.dtype)
        functions = []
        for k in range(3):
            i, j = tri[:, (k + 1) % 3], tri[:, (k + 2) % 3]
            flip = jnp.where(i < j, 1.0, -1.0).astype(xy.dtype)[:, None]
            u = xy[jnp.minimum(i, j)][:, None] - p
            v = xy[jnp.maximum(i, j)][:, None] - p
            functions.append(flip * (u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]))
        a, b, c = functions
        inside = ((a >= 0) & (b >= 0) & (c >= 0)) | ((a <= 0) & (b <= 0) & (c <= 0))
        inside &= (a + b + c) != 0
        x, y = at[..., 0], at[..., 1]
        inside &= (x >= 0) & (x < width) & (y >= 0) & (y < height)
        flat = jnp.where(inside, y * width + x, height * width)
        return owner.at[flat].min(jnp.broadcast_to(ids[:, None], flat.shape), mode="drop"), None

    start = jnp.full((height * width,), no_face, jnp.int32)
    owner, _ = jax.lax.scan(block, start, (faces, low, index))
    return owner
