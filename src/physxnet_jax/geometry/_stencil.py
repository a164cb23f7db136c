"""Averages over neighbourhoods of a mesh."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Float, Int
from scipy.sparse.csgraph import dijkstra

from ..typing import pytree
from ._topology import mesh_edges

# Rows of the distance matrix computed at once.
_CHUNK = 512
# Maximum number of finer stencils after one with more rows in reach than it takes.
_MAX_FINER_STENCILS = 3


@pytree
@dataclasses.dataclass(frozen=True)
class Stencil:
    """A weighted mean of other rows for each row.

    Attributes:
        index: Rows taken, shape [rows, k].
        weight: Their weights, which sum to 1, shape [rows, k].
    """

    index: Int[Array, "rows k"]
    weight: Float[Array, "rows k"]

    def __matmul__(self, values: Float[Array, "*batch rows channels"]) -> Array:
        """The means, of the same shape as the values."""
        return _means(self.index, self.weight, values)


@jax.jit
def _means(index: Array, weight: Array, values: Array) -> Array:
    # Gathering whole rows of a batch at once takes far fewer, longer copies.
    rows = jnp.moveaxis(values, -2, 0)
    wide = rows.reshape(rows.shape[0], -1)
    out = jnp.zeros_like(wide)
    for k in range(index.shape[1]):
        out = out + weight[:, k, None] * wide[index[:, k]]
    return jnp.moveaxis(out.reshape(rows.shape), 0, -2)


def gaussian_stencil(
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    radius: float,
    *,
    size: int = 16,
) -> Stencil:
    """Gaussian means over a mesh, by distance along its edges.

    Args:
        vertices: Positions [m].
        faces: Triangles.
        radius: Standard deviation [m]; vertices within 2.2 radii contribute.
        size: Number of vertices. If more are within reach, they are sampled evenly in
            order of distance; applying the stencil twice compensates for that.

    Returns:
        The stencil; unconnected vertices keep their own value.
    """
    count = len(vertices)
    edges = mesh_edges(faces).vertices
    # The sparse graph treats an edge of length zero as absent.
    length = np.maximum(np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1), 1e-9)
    graph = sp.csr_matrix((length, (edges[:, 0], edges[:, 1])), (count, count))
    index = np.repeat(np.arange(count, dtype=np.int32)[:, None], size, axis=1)
    weight = np.zeros((count, size))
    for start in range(0, count, _CHUNK):
        rows = np.arange(start, min(start + _CHUNK, count))
        far = dijkstra(graph, directed=False, indices=rows, limit=2.2 * radius)
        for row, d in zip(rows, far, strict=True):
            near = np.flatnonzero(np.isfinite(d))
            near = near[np.argsort(d[near], kind="stable")]
            if len(near) > size:
                near = near[np.linspace(0, len(near) - 1, size).astype(int)]
            index[row, : len(near)] = near
            weight[row, : len(near)] = np.exp(-0.5 * (d[near] / radius) ** 2)
    weight /= weight.sum(axis=1, keepdims=True)
    return Stencil(jax.device_put(index), jax.device_put(weight.astype(np.float32)))


@pytree
@dataclasses.dataclass(frozen=True)
class Smoothing:
    """A sequence of weighted means.

    Attributes:
        stencils: The means, in order of application.
    """

    stencils: tuple[Stencil, ...]

    def __matmul__(self, values: Float[Array, "*batch rows channels"]) -> Array:
        """The smoothed values, of the same shape."""
        for stencil in self.stencils:
            values = stencil @ values
        return values


def gaussian_smoothing(
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    radius: float,
) -> Smoothing:
    """Gaussian smoothing over a mesh that leaves no lumps at any mesh resolution.

    A stencil takes only a few rows. If more are within reach, neighbours sample different
    ones and their means differ. Stencils of half the radius follow until most vertices
    average all rows within reach.

    Args:
        vertices: Positions [m].
        faces: Triangles.
        radius: Standard deviation of the widest mean [m].

    Returns:
        The smoothing, which preserves constants.

    References:
        Burt, Fast Filter Transforms for Image Processing (1981): wide kernels from
        sparse ones of several sizes.
    """
    stencils = []
    for _ in range(_MAX_FINER_STENCILS + 1):
        stencil = gaussian_stencil(vertices, faces, radius)
        crowded = np.mean(np.asarray(stencil.weight[:, -1]) > 0) > 0.5
        # Applied twice, which evens out the sampling (see `gaussian_stencil`).
        stencils += [stencil, stencil] if crowded and not stencils else [stencil]
        if not crowded:
            break
        radius = 0.5 * radius
    return Smoothing(tuple(stencils))
