"""Lossless predictive coding of cloth: only residuals are stored."""

import dataclasses

import numpy as np
from jaxtyping import Float, Int, UInt
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial.distance import cdist

from ..geometry import mesh_edges

# Number of vertices that each one is predicted from.
_NUM_PARENTS = 10
# Correlation length of the motion of cloth [m].
_LENGTH_SCALE = 0.06
# Variance of a vertex's independent motion, relative to that of the shared motion.
_NOISE_VARIANCE = 1e-2
# Weights are stored in units of 1/4096, so that every machine decodes the same numbers.
_WEIGHT_UNIT = 4096
_MAX_DISTANCE = 10.0


@dataclasses.dataclass(frozen=True)
class Codec:
    """Predicts the motion of each vertex from vertices that precede it.

    Vertices are in farthest-point order: each is the farthest from all that precede it.
    All but the first few lie between others and are interpolated instead of extrapolated.

    Attributes:
        order: Vertices in coding order.
        parents: Vertices that each one is predicted from.
        weights: Weights of the prediction [1/4096].
    """

    order: Int[np.ndarray, " vertices"]
    parents: Int[np.ndarray, "vertices parents"]
    weights: Int[np.ndarray, "vertices parents"]

    def encode(
        self, values: Int[np.ndarray, "frames vertices 3"]
    ) -> UInt[np.ndarray, "3 vertices frames"]:
        """Residuals of integers after temporal and spatial prediction, zigzag-coded."""
        motion = np.diff(values.astype(np.int64), axis=0, prepend=0)
        residuals = motion - self._predict_residual(motion, np.arange(len(self.order)))
        residuals = np.where(residuals >= 0, 2 * residuals, -2 * residuals - 1)
        return residuals[:, self.order].transpose(2, 1, 0).astype(np.uint32)

    def decode(
        self, residuals: UInt[np.ndarray, "3 vertices frames"]
    ) -> Int[np.ndarray, "frames vertices 3"]:
        """Restores the integers from their residuals."""
        residuals = residuals.transpose(2, 1, 0).astype(np.int64)
        residuals = np.where(residuals % 2 == 0, residuals // 2, -(residuals + 1) // 2)
        motion = np.empty_like(residuals)
        motion[:, self.order] = residuals
        for rows in self._generations():
            motion[:, rows] += self._predict_residual(motion, rows)
        return np.cumsum(motion, axis=0)

    def _predict_residual(self, motion: np.ndarray, rows: np.ndarray) -> np.ndarray:
        total = np.full((len(motion), len(rows), 3), _WEIGHT_UNIT // 2, np.int64)
        for k in range(self.parents.shape[1]):
            total += self.weights[rows, k][:, None] * motion[:, self.parents[rows, k]]
        return total // _WEIGHT_UNIT

    def _generations(self) -> list[np.ndarray]:
        """Groups of vertices that can be decoded at once, as all their parents are known."""
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
        prediction in space and time; the weights are those of a Gaussian process.
    """
    x = np.asarray(vertices, np.float64)
    n = len(x)
    edges = mesh_edges(faces).vertices
    length = np.linalg.norm(x[edges[:, 0]] - x[edges[:, 1]], axis=1)
    graph = coo_matrix((np.maximum(length, 1e-9), (edges[:, 0], edges[:, 1])), shape=(n, n))
    apart = np.minimum(dijkstra((graph + graph.T).tocsr()), _MAX_DISTANCE)
    order = np.empty(n, np.int64)
    gap = np.full(n, np.inf)
    v = 0
    for k in range(n):
        order[k] = v
        gap = np.minimum(gap, apart[v])
        gap[v] = -1.0
        v = int(gap.argmax())
    parents = np.zeros((n, _NUM_PARENTS), np.int64)
    weights = np.zeros((n, _NUM_PARENTS), np.int64)
    for k in range(1, n):
        v, before = order[k], order[:k]
        near = before[np.argsort(apart[v, before], kind="stable")[:_NUM_PARENTS]]
        kernel = np.exp(-0.5 * (cdist(x[near], x[near]) / _LENGTH_SCALE) ** 2)
        covariance = np.exp(-0.5 * (np.linalg.norm(x[near] - x[v], axis=1) / _LENGTH_SCALE) ** 2)
        share = np.linalg.solve(kernel + _NOISE_VARIANCE * np.eye(len(near)), covariance)
        parents[v, : len(near)] = near
        weights[v, : len(near)] = np.round(_WEIGHT_UNIT * share)
    return Codec(order, parents, weights)
