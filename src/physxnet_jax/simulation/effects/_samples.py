"""Sample points on large edges and faces of the cloth, which feel contact as vertices do."""

import dataclasses
import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ...geometry import mesh_edges
from ...typing import pytree
from .._assembly import float32


@pytree
@dataclasses.dataclass(frozen=True)
class Samples:
    """Points of triangles, and how their corrections go back to the corners.

    Attributes:
        corners: Corners of each sample; those of an edge repeat the last.
        weights: Their barycentric weights.
        owners: Vertices that are a corner of a sample.
        near: Samples of each owner, with the number of samples for padding.
        share: Weight of the owner in each of them over the sum of the sample's squared weights;
            0 for padding.
    """

    corners: Int[Array, "3 samples"]
    weights: Float[Array, "3 samples"]
    owners: Int[Array, " owners"]
    near: Int[Array, "most owners"]
    share: Float[Array, "most owners"]

    @property
    def count(self) -> int:
        """Number of samples."""
        return self.corners.shape[1]

    def points(self, x: Float[Array, "vertices 3 batch"]) -> Float[Array, "samples 3 batch"]:
        """Values at the samples."""
        w = self.weights[..., None, None]
        a, b, c = (x[i] for i in self.corners)
        # From differences, which float32 keeps far from the origin.
        return a + (w[1] * (b - a) + w[2] * (c - a))

    def extend(self, x: Float[Array, "vertices 3 batch"]) -> Float[Array, "points 3 batch"]:
        """Values at the vertices, followed by those at the samples."""
        return jnp.concatenate([x, self.points(x)]) if self.count else x

    def push(
        self,
        x: Float[Array, "vertices 3 batch"],
        move: Float[Array, "samples 3 batch"],
        acts: Bool[Array, "samples 1 batch"],
        free: Float[Array, "vertices 1"],
    ) -> Float[Array, "vertices 3 batch"]:
        """Moves vertices so that the samples move; each takes the mean over those that act.

        Args:
            x: Displacements [m].
            move: Moves of the samples [m].
            acts: Samples that act.
            free: 1 for vertices that can move, 0 for held ones.
        """
        padding = ((0, 1), (0, 0), (0, 0))
        move = jnp.pad(jnp.where(acts, move, 0.0), padding)
        number = jnp.pad(acts.astype(move.dtype), padding)
        total = jnp.sum(self.share[..., None, None] * move[self.near], axis=0)
        mean = total / jnp.maximum(jnp.sum(number[self.near], axis=0), 1.0)
        mean = mean * free[self.owners][..., None]
        return x.at[self.owners].add(mean, unique_indices=True)


def sample_faces(
    x: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"], spacing: float
) -> Samples:
    """Samples of edges and faces so that no two neighbouring points are farther apart.

    Args:
        x: Rest positions [m].
        faces: Triangles.
        spacing: Largest distance [m].
    """
    corners: list[tuple[int, int, int]] = []
    weights: list[tuple[float, float, float]] = []
    edges = mesh_edges(faces).vertices
    for a, b in edges:
        n = math.ceil(float(np.linalg.norm(x[a] - x[b])) / spacing)
        for k in range(1, n):
            corners.append((a, b, b))
            weights.append((1.0 - k / n, k / n, 0.0))
    for a, b, c in faces:
        sides = (x[a] - x[b], x[b] - x[c], x[c] - x[a])
        n = math.ceil(max(float(np.linalg.norm(side)) for side in sides) / spacing)
        for i in range(1, n - 1):
            for j in range(1, n - i):
                corners.append((a, b, c))
                weights.append(((n - i - j) / n, i / n, j / n))
    at = np.asarray(corners, np.int64).reshape(-1, 3)
    w = np.asarray(weights, np.float64).reshape(-1, 3)
    # A sample that repeats a corner counts once for it.
    used = w > 0
    vertex, sample = at[used], np.nonzero(used)[0]
    share = (w / np.maximum((w * w).sum(axis=1, keepdims=True), 1e-12))[used]
    order = np.argsort(vertex, kind="stable")
    owners, first, number = np.unique(vertex[order], return_index=True, return_counts=True)
    most = int(number.max(initial=0))
    near = np.full((most, len(owners)), len(at), np.int64)
    shares = np.zeros((most, len(owners)))
    rank = np.arange(len(order)) - np.repeat(first, number)
    column = np.repeat(np.arange(len(owners)), number)
    near[rank, column], shares[rank, column] = sample[order], share[order]
    return Samples(
        jnp.asarray(at.T.astype(np.int32)),
        float32(w.T),
        jnp.asarray(owners.astype(np.int32)),
        jnp.asarray(near.astype(np.int32)),
        float32(shares),
    )
