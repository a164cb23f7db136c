"""Sample points on large edges and faces of the cloth, which feel contact as vertices do."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ...geometry import materialize, mesh_edges
from ...typing import pytree
from .._assembly import Assembly, float32


@pytree
@dataclasses.dataclass(frozen=True)
class Samples:
    """Points of triangles, and how their corrections go back to the corners.

    Attributes:
        corners: Corners of each sample; those of an edge repeat the last.
        weights: Their barycentric weights.
        shares: The weights over the sum of the sample's squared weights.
        counts: 1 for each corner, 0 for a repeated one.
    """

    corners: Int[Array, "3 samples"]
    weights: Float[Array, "3 samples"]
    shares: Float[Array, "3 samples"]
    counts: Float[Array, "3 samples"]

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
        acts: Float[Array, "samples 1 batch"],
        free: Float[Array, "vertices 1"],
    ) -> Float[Array, "vertices 3 batch"]:
        """Moves vertices so that the samples move; each takes the mean over those that act.

        Args:
            x: Displacements [m].
            move: Moves of the samples [m].
            acts: 1 for samples that act, else 0.
            free: 1 for vertices that can move, 0 for held ones.
        """
        rows = materialize(jnp.concatenate([acts * move, acts], axis=1))
        total = jnp.zeros((len(x), *rows.shape[1:]), x.dtype)
        for corner, share, counts in zip(self.corners, self.shares, self.counts, strict=True):
            weight = jnp.stack([share, share, share, counts], axis=1)[..., None]
            total = total.at[corner].add(weight * rows)
        mean = total[:, :3] / jnp.maximum(total[:, 3:], 1.0)
        return x + mean * free[..., None]


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
    return Samples(
        jax.device_put(at.T.astype(np.int32)),
        float32(w.T),
        float32((w / np.maximum((w * w).sum(axis=1, keepdims=True), 1e-12)).T),
        float32((w > 0).T),
    )


def with_samples(assembly: Assembly, samples: Samples) -> Assembly:
    """The vertices with the samples after them, for everything that contact needs of them."""
    corners, weights = np.asarray(samples.corners), np.asarray(samples.weights)

    def more(x: np.ndarray) -> np.ndarray:
        there = np.einsum("ks,ks...->s...", weights, x[corners])
        return np.concatenate([x, there.astype(x.dtype)])

    def some(x: np.ndarray) -> np.ndarray:
        return np.concatenate([x, x[corners].any(axis=0)])

    return dataclasses.replace(
        assembly,
        rest=more(assembly.rest),
        mass=more(assembly.mass),
        pinned=some(assembly.pinned),
        weights=more(assembly.weights),
        thickness=more(assembly.thickness),
        friction=more(assembly.friction),
        loose=some(assembly.loose),
        hanging=some(assembly.hanging),
    )
