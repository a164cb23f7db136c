"""Averages over neighbourhoods of a mesh."""

import dataclasses
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Float, Int
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import KDTree

from ..typing import pytree
from ._candidates import spread_points
from ._materialize import materialize
from ._topology import mesh_edges

# Rows of the distance matrix computed at once.
_CHUNK = 512
# Meshes of more vertices are looked at for being fine, and are if a radius has so many more.
_FINE, _FINER = 8192, 8
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
    # Not computed anew for each of the rows that take them.
    wide = materialize(rows.reshape(rows.shape[0], -1))
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
            order of distance; applying the stencil twice compensates for that. Of a mesh much
            finer than the radius, only vertices half a radius apart are sampled.

    Returns:
        The stencil; unconnected vertices keep their own value.
    """
    count = len(vertices)
    edges = mesh_edges(faces).vertices
    # The sparse graph treats an edge of length zero as absent.
    length = np.maximum(np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1), 1e-9)
    graph = sp.csr_matrix((length, (edges[:, 0], edges[:, 1])), (count, count))
    graph = (graph + graph.T).tocsr()
    index = np.repeat(np.arange(count, dtype=np.int32)[:, None], size, axis=1)
    weight = np.zeros((count, size))
    sites = np.arange(count)
    if count > _FINE:
        # Each part has sites of its own, however near others lie.
        part = connected_components(graph, directed=False)[1]
        aside = part[:, None] * [np.ptp(vertices[:, 0]) + radius, 0.0, 0.0]
        some = np.sort(spread_points(vertices + aside, 0.5 * radius))
        sites = some if count > _FINER * len(some) else sites
    if len(sites) == count:
        for rows, box, far in _reached(graph, vertices, sites, 2.2 * radius):
            for row, d in zip(rows, far, strict=True):
                near = np.flatnonzero(np.isfinite(d))
                near = near[np.argsort(d[near], kind="stable")]
                if len(near) > size:
                    near = near[np.linspace(0, len(near) - 1, size).astype(int)]
                index[row, : len(near)] = box[near]
                weight[row, : len(near)] = np.exp(-0.5 * (d[near] / radius) ** 2)
    else:
        found = []
        for rows, box, far in _reached(graph, vertices, sites, 2.2 * radius):
            site, row = np.nonzero(np.isfinite(far))
            found.append((box[row], rows[site], far[site, row]))
        row, site, distance = (np.concatenate(x) for x in zip(*found, strict=True))
        order = np.lexsort((site, distance, row))
        row, site, distance = row[order], site[order], distance[order]
        first, number = np.searchsorted(row, np.arange(count)), np.bincount(row, minlength=count)
        for k in range(size):
            # All of few, and of many as many, from the nearest to the farthest.
            at = np.where(number > size, k * (number - 1) // (size - 1), k)
            on = np.flatnonzero(at < number)
            pick = first[on] + at[on]
            index[on, k] = site[pick]
            weight[on, k] = np.exp(-0.5 * (distance[pick] / radius) ** 2)
    weight /= weight.sum(axis=1, keepdims=True)
    return Stencil(jax.device_put(index), jax.device_put(weight.astype(np.float32)))


def _reached(
    graph: sp.csr_matrix,
    vertices: Float[np.ndarray, "vertices 3"],
    sources: Int[np.ndarray, " sources"],
    reach: float,
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Distances along edges within a reach [m]: sources, vertices, and a row for each source.

    Sources that lie beside each other come together: their paths stay within the box around them,
    so that the distances to all other vertices needn't be held.
    """
    order = KDTree(vertices[sources], leafsize=_CHUNK).indices
    for start in range(0, len(order), _CHUNK):
        rows = np.sort(sources[order[start : start + _CHUNK]])
        low, high = vertices[rows].min(axis=0) - reach, vertices[rows].max(axis=0) + reach
        box = np.flatnonzero(((vertices >= low) & (vertices <= high)).all(axis=1))
        at = np.searchsorted(box, rows)
        yield rows, box, dijkstra(graph[box][:, box], directed=False, indices=at, limit=reach)


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
