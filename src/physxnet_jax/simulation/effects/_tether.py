"""Tethers: hanging cloth stays within its length of the cloth that it hangs from."""

import dataclasses
import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Float, Int
from scipy.sparse.csgraph import dijkstra

from ...errors import check_numbers
from ...geometry import mesh_edges
from ...typing import pytree
from .._assembly import Assembly, float32, norm
from .._effect import Clock, Effect, Prepared, Rest, Step
from ._guide import faces_between

# Rings of neighbours that paths step over: along edges alone they would be a tenth too long.
_RINGS = 3


@dataclasses.dataclass(frozen=True)
class Tether(Effect):
    """Bounds the distance of hanging vertices from the nearest snug one by that along the cloth.

    Few substeps stretch long skirts under their own weight, because each sweep passes tension on by
    one edge only. A tether takes it up at once. Snug vertices aren't moved.

    Attributes:
        slack: Elongation that is allowed [1].

    References:
        Kim, Chentanez and Mueller-Fischer, Long range attachments (2012).
    """

    slack: float = 0.0

    def __post_init__(self) -> None:
        check_numbers(self, "slack", zero=True)

    def prepare(self, assembly: Assembly, inverse_mass: Array) -> Prepared:
        """Finds the snug vertex nearest to each hanging one, and its distance along the cloth."""
        anchor = np.arange(len(assembly.rest))
        length = np.zeros(len(assembly.rest))
        for a, b in itertools.pairwise(assembly.parts):
            part = slice(a, b)
            faces = faces_between(assembly.faces, a, b)
            snug = np.flatnonzero(~assembly.hanging[part])
            found, far = _nearest(assembly.rest[part], faces, snug)
            anchor[part], length[part] = a + found, far
        rest = float32(assembly.rest)
        return _Tether(
            jax.device_put(anchor),
            float32((1.0 + self.slack) * length),
            norm(rest - rest[anchor]),
        )

    def idle(self, assembly: Assembly) -> bool:
        """Where nothing hangs."""
        return not assembly.hanging.any()


@pytree
@dataclasses.dataclass(frozen=True)
class _Tether(Prepared):
    """Tethers of a scene's cloth.

    Attributes:
        anchor: The snug vertex of each vertex, itself if none, shape [vertices].
        length: Largest distance from it [m], shape [vertices].
        straight: Distance from it at rest [m], shape [vertices].
    """

    anchor: Int[Array, " vertices"]
    length: Float[Array, " vertices"]
    straight: Float[Array, " vertices"]

    def reshaped(self, rest: Rest) -> Prepared:
        # Lengths along the cloth change as the straight ones do.
        straight = norm(rest.cloth - rest.cloth[self.anchor])
        known = jnp.where(self.straight > 0.0, self.straight, 1.0)
        return dataclasses.replace(self, length=self.length * straight / known, straight=straight)

    def begin(self, base: Array, start: Any, end: Any, clock: Clock, state: Any) -> Array:
        return base - base[self.anchor]

    def project(
        self, displacement: Array, start: Array, context: Array, progress: Array, step: Step
    ) -> Array:
        away = context + displacement - displacement[self.anchor]
        squared = jnp.sum(away * away, axis=1, keepdims=True)
        longest = self.length[:, None, None]
        taut = squared > longest * longest
        over = jnp.where(taut, 1.0 - longest / jnp.sqrt(jnp.where(taut, squared, 1.0)), 0.0)
        return displacement - over * away


def _nearest(
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    sources: Int[np.ndarray, " sources"],
) -> tuple[Int[np.ndarray, " vertices"], Float[np.ndarray, " vertices"]]:
    """The nearest source along a mesh and its distance [m]; itself and 0 where there is none."""
    ends = mesh_edges(faces).vertices
    n = len(vertices)
    next_to = sp.csr_matrix((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), (n, n))
    next_to = next_to + next_to.T + sp.identity(n)
    within = next_to
    for _ in range(_RINGS - 1):
        within = within @ next_to
    pairs = sp.triu(within, 1).tocoo()
    far = np.linalg.norm(vertices[pairs.row] - vertices[pairs.col], axis=1)
    graph = sp.csr_matrix((np.maximum(far, 1e-9), (pairs.row, pairs.col)), (n, n))
    distance, _, source = dijkstra(
        graph, directed=False, indices=sources, min_only=True, return_predecessors=True
    )
    reached = np.isfinite(distance)
    return np.where(reached, source, np.arange(n)), np.where(reached, distance, 0.0)
