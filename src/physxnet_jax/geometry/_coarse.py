"""Coarse meshes on some of a fine mesh's vertices, and how values spread from them."""

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Int
from scipy.sparse.csgraph import dijkstra

from ._candidates import spread_points
from ._topology import connected_components, mesh_edges

FINE_MESH, NUM_SITES = 16_384, 8_192
"""Meshes of more vertices are fine; about how many of them are sites."""
# Greedily chosen points leave this share of their squared spacing to each.
_DENSITY = 0.8
# Vertices farther from all sites, in spacings along edges, get sites of their own.
_FARTHEST, _ROUNDS = 2.0, 4
# Sites that a vertex compares, and those that contribute: the next one's weight is zero, so that
# weights are continuous.
_NEIGHBOURS = 8
_RIDGE = 1e-4


def coarse_mesh(
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    count: int,
    first: Int[np.ndarray, " first"] | None = None,
) -> tuple[Int[np.ndarray, " sites"], Int[np.ndarray, "coarse 3"], Int[np.ndarray, " vertices"]]:
    """A mesh on about ``count`` evenly spaced vertices, the sites, of a finer one.

    Each vertex belongs to the site that is nearest along edges; three sites whose regions meet in a
    triangle make one. Borders and unconnected parts have sites of their own.

    Args:
        vertices: Positions [m].
        faces: Triangles.
        count: Number of sites, about.
        first: Vertices that are preferred as sites.

    Returns:
        The sites' vertices; triangles between sites, numbered in that order; and each vertex's
        site, -1 where no triangle has the vertex.

    References:
        Peyré and Cohen, Geodesic remeshing using front propagation (2006).
    """
    edges = mesh_edges(faces)
    pairs = edges.vertices
    length = np.linalg.norm(vertices[pairs[:, 0]] - vertices[pairs[:, 1]], axis=1)
    # The sparse graph treats an edge of length zero as absent.
    graph = sp.csr_matrix(
        (np.maximum(length, 1e-9), (pairs[:, 0], pairs[:, 1])), (len(vertices),) * 2
    )
    part = connected_components(faces, len(vertices))
    used = np.zeros(len(vertices), bool)
    used[faces] = True
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
    spacing = float(np.sqrt(_DENSITY * area / count))
    border = np.unique(pairs[edges.count == 1])
    wanted = np.concatenate([border if first is None else first, border, np.flatnonzero(used)])
    order = wanted[np.sort(np.unique(wanted, return_index=True)[1])]
    # Parts lie aside of each other, however near they are.
    apart = vertices + part[:, None] * [np.ptp(vertices[:, 0]) + 2.0 * spacing, 0.0, 0.0]
    sites = order[spread_points(apart[order], spacing)]
    for _ in range(_ROUNDS):
        far, _, owner = dijkstra(
            graph, directed=False, indices=sites, min_only=True, return_predecessors=True
        )
        lacking = order[far[order] > _FARTHEST * spacing]
        if not len(lacking):
            break
        sites = np.concatenate([sites, lacking[spread_points(apart[lacking], spacing)]])
    number = np.full(len(vertices), -1)
    number[sites] = np.arange(len(sites))
    # Vertices that no site reaches have a negative owner.
    label = np.where(owner >= 0, number[np.maximum(owner, 0)], -1)
    label[sites] = np.arange(len(sites))
    found = label[faces]
    a, b, c = found.T
    found = found[(a != b) & (b != c) & (c != a) & (found >= 0).all(axis=1)]
    kept = np.sort(np.unique(np.sort(found, axis=1), axis=0, return_index=True)[1])
    return sites, found[kept], label


def linear_weights(
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    sites: Int[np.ndarray, " sites"],
    label: Int[np.ndarray, " vertices"],
) -> tuple[Int[np.ndarray, "vertices k"], Float[np.ndarray, "vertices k"]]:
    """How each vertex mixes values of nearby sites: what is linear along the mesh stays so.

    Args:
        vertices: Positions [m].
        faces: Triangles.
        sites: The sites' vertices.
        label: Each vertex's site, from `coarse_mesh`; -1 for none.

    Returns:
        Sites of each vertex and their weights, which sum to 1, or are 0 for vertices without site.

    References:
        Levin, The approximation power of moving least-squares (1998).
    """
    pairs = label[mesh_edges(faces).vertices]
    pairs = pairs[(pairs[:, 0] != pairs[:, 1]) & (pairs >= 0).all(axis=1)]
    count = len(sites)
    beside = sp.coo_matrix((np.ones(len(pairs)), pairs.T), (count, count)).tocsr()
    beside = beside + beside.T + sp.identity(count, format="csr")
    around = (beside @ beside).tocsr()
    widest = int(np.diff(around.indptr).max())
    table = np.repeat(np.arange(count)[:, None], widest, axis=1)
    there = np.arange(widest)[None] < np.diff(around.indptr)[:, None]
    table[there] = around.indices
    near = table[label]
    gap = vertices[sites][near] - vertices[:, None]
    distance = np.where(there[label], np.linalg.norm(gap, axis=2), np.inf)
    order = np.argsort(distance, axis=1, kind="stable")[:, : _NEIGHBOURS + 1]
    near, distance = (np.take_along_axis(x, order, axis=1) for x in (near, distance))
    gap = np.take_along_axis(gap, order[:, :, None], axis=1)
    finite = np.isfinite(distance)
    # Where there are few sites, all contribute.
    reach = np.where(
        finite.sum(axis=1) > _NEIGHBOURS,
        distance[:, -1],
        1.5 * np.where(finite, distance, 0.0).max(axis=1) + 1e-9,
    )
    share = np.where(finite, np.clip(1.0 - (distance / reach[:, None]) ** 2, 0.0, None) ** 2, 0.0)
    near, share, gap = near[:, :_NEIGHBOURS], share[:, :_NEIGHBOURS], gap[:, :_NEIGHBOURS]
    share = share + 1e-9 * (np.arange(share.shape[1]) == 0)
    mean = np.einsum("vk,vkx->vx", share, gap) / share.sum(axis=1)[:, None]
    spread = gap - mean[:, None]
    moments = np.einsum("vk,vkx,vky->vxy", share, spread, spread)
    # Along the surface only: across it sites hardly differ, and slopes would be noise.
    size, axes = np.linalg.eigh(moments)
    along = np.einsum("vkx,vxy->vky", spread, axes[:, :, 1:])
    wanted = np.einsum("vx,vxy->vy", -mean, axes[:, :, 1:])
    slope = wanted / (size[:, 1:] + _RIDGE * size[:, 2:] + 1e-18)
    weight = share / share.sum(axis=1)[:, None] + share * np.einsum("vky,vy->vk", along, slope)
    return near, np.where(label[:, None] >= 0, weight, 0.0)
