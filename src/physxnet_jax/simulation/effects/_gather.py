"""Rows of arrays by index, coordinate by coordinate: XLA vectorises gathers of scalars alone."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ...geometry import closest_barycentric, materialize, nearest_distinct, nearest_index

# Triangles of a patch that are compared exactly: those with the nearest middles.
_EXACT = 3


def gather(
    x: Float[Array, "vertices 3 batch"], index: Int[Array, "*some batch"]
) -> list[Float[Array, "*some batch"]]:
    """The three coordinates of each batch member's rows."""
    lane = jax.lax.broadcasted_iota(index.dtype, index.shape, index.ndim - 1)
    flat = index * x.shape[2] + lane
    return [x[:, i].reshape(-1)[flat] for i in range(3)]


def gather_corners(
    x: Float[Array, "vertices 3 batch"], index: Int[Array, "..."], axis: int
) -> list[Float[Array, "3 ..."]]:
    """The three corners of triangles, which an axis of ``index`` lists."""
    index = jnp.moveaxis(index, axis, 0)
    return [jnp.stack(gather(x, index[k])) for k in range(3)]


def pick_nearest(
    points: Float[Array, "some 3 batch"],
    x: Float[Array, "vertices 3 batch"],
    candidates: Int[Array, "candidates some batch"],
) -> Int[Array, "some batch"]:
    """The nearest of each point's candidates among the rows of ``x``."""
    there = gather(x, candidates)
    a, b, c = (there[i] - points[None, :, i] for i in range(3))
    gap = a * a + b * b + c * c
    return jnp.take_along_axis(candidates, nearest_index(gap)[None], axis=0)[0]


def nearest_face(
    points: Float[Array, "some 3 batch"],
    x: Float[Array, "vertices 3 batch"],
    faces: Int[Array, "faces 3"],
    patch: Int[Array, "candidates some batch"],
) -> Int[Array, "some batch"]:
    """The triangle nearest to each point among its candidates, of which a few are compared exactly.

    Args:
        points: Points [m].
        x: Vertices of the triangles [m].
        faces: All triangles.
        patch: Indices of each point's candidates.
    """
    p = jnp.moveaxis(points, 1, 0)
    middles = materialize((x[faces[:, 0]] + x[faces[:, 1]] + x[faces[:, 2]]) / 3.0)
    few = patch
    if len(patch) > _EXACT:
        a, b, c = (m - q[None] for m, q in zip(gather(middles, patch), p, strict=True))
        few = nearest_distinct(a * a + b * b + c * c, patch, _EXACT)
    tri = materialize(gather_corners(x, faces[few], axis=-1))
    _, squared = closest_barycentric(jnp.broadcast_to(p[:, None], tri[0].shape), *tri)
    return jnp.take_along_axis(few, nearest_index(materialize(squared))[None], axis=0)[0]
