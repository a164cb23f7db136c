"""Cloth on disk without loss: what neighbours and the frame before tell isn't stored."""

import dataclasses

import numpy as np
from jaxtyping import Float, Int, UInt
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial.distance import cdist

from ..geometry import mesh_edges

# Vertices that each one is foretold from.
_PARENTS = 10
# Cloth moves alike over this distance [m].
_ALIKE = 0.06
# How little of a movement is shared, relative to all of it.
_OWN = 1e-2
# Weights are whole parts of this, so that every machine decodes the same numbers.
_ONE = 4096
_FAR = 10.0


@dataclasses.dataclass(frozen=True)
class Codec:
    """Foretells how a vertex moves from vertices that come before it.

    Vertices are ordered so that each is the farthest from all before it: all but the
    first few lie between others, and are interpolated instead of extrapolated.

    Attributes:
        order: Vertices in their order.
        parents: Those each one is foretold from.
        weights: With which weights [1/4096].
    """

    order: Int[np.ndarray, " vertices"]
    parents: Int[np.ndarray, "vertices parents"]
    weights: Int[np.ndarray, "vertices parents"]

    def encode(
        self, values: Int[np.ndarray, "frames vertices 3"]
    ) -> UInt[np.ndarray, "3 vertices frames"]:
        """What is left of whole numbers once the foretold part is taken away."""
        moved = np.diff(values.astype(np.int64), axis=0, prepend=0)
        left = moved - self._foretell(moved, np.arange(len(self.order)))
        left = np.where(left >= 0, 2 * left, -2 * left - 1)
        return left[:, self.order].transpose(2, 1, 0).astype(np.uint32)

    def decode(
        self, left: UInt[np.ndarray, "3 vertices frames"]
    ) -> Int[np.ndarray, "frames vertices 3"]:
        """The whole numbers again."""
        left = left.transpose(2, 1, 0).astype(np.int64)
        left = np.where(left % 2 == 0, left // 2, -(left + 1) // 2)
        moved = np.empty_like(left)
        moved[:, self.order] = left
        for rows in self._generations():
            moved[:, rows] += self._foretell(moved, rows)
        return np.cumsum(moved, axis=0)

    def _foretell(self, moved: np.ndarray, rows: np.ndarray) -> np.ndarray:
        total = np.full((len(moved), len(rows), 3), _ONE // 2, np.int64)
        for k in range(self.parents.shape[1]):
            total += self.weights[rows, k][:, None] * moved[:, self.parents[rows, k]]
        return total // _ONE

    def _generations(self) -> list[np.ndarray]:
        """Vertices that can be told at once, as all their parents are known."""
        age = np.zeros(len(self.order), np.int64)
        for v in self.order:
            used = self.parents[v][self.weights[v] != 0]
            age[v] = 1 + age[used].max(initial=-1)
        return [np.flatnonzero(age == a) for a in range(1, int(age.max(initial=0)) + 1)]


def make_codec(
    vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> Codec:
    """The codec of a mesh at rest.

    Args:
        vertices: Positions [m].
        faces: Triangles.

    References:
        Karni and Gotsman, Compression of soft-body animation sequences (2004), for
        foretelling in space and time; the weights are those of a Gaussian process.
    """
    x = np.asarray(vertices, np.float64)
    n = len(x)
    edges = mesh_edges(faces).vertices
    length = np.linalg.norm(x[edges[:, 0]] - x[edges[:, 1]], axis=1)
    graph = coo_matrix((np.maximum(length, 1e-9), (edges[:, 0], edges[:, 1])), shape=(n, n))
    apart = np.minimum(dijkstra((graph + graph.T).tocsr()), _FAR)
    order = np.empty(n, np.int64)
    gap = np.full(n, np.inf)
    v = 0
    for k in range(n):
        order[k] = v
        gap = np.minimum(gap, apart[v])
        gap[v] = -1.0
        v = int(gap.argmax())
    parents = np.zeros((n, _PARENTS), np.int64)
    weights = np.zeros((n, _PARENTS), np.int64)
    for k in range(1, n):
        v, before = order[k], order[:k]
        near = before[np.argsort(apart[v, before], kind="stable")[:_PARENTS]]
        alike = np.exp(-0.5 * (cdist(x[near], x[near]) / _ALIKE) ** 2)
        to = np.exp(-0.5 * (np.linalg.norm(x[near] - x[v], axis=1) / _ALIKE) ** 2)
        share = np.linalg.solve(alike + _OWN * np.eye(len(near)), to)
        parents[v, : len(near)] = near
        weights[v, : len(near)] = np.round(_ONE * share)
    return Codec(order, parents, weights)
