"""Guide: patch means of the cloth are drawn to where a prediction has them."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Float, Int
from scipy.sparse.csgraph import dijkstra

from ...errors import check_numbers
from ...geometry import mesh_edges, pad_rows
from ...typing import pytree
from .._assembly import Assembly, float32
from .._effect import Clock, Effect, Prepared, Step

# Patches that a vertex belongs to, and their width over the distance of their middles [1].
_SHARED, _WIDTH = 4, 0.7


@dataclasses.dataclass(frozen=True)
class Guide(Effect):
    """Draws the means of patches to given positions; folds within a patch are left to the cloth.

    Positions are given to `advance` frame by frame; without them nothing is drawn. Each mean hangs
    on a critically damped spring, whose stiffness doesn't depend on the substep.

    Attributes:
        spacing: Distance between the middles of patches along the cloth [m].
        time_constant: Inverse of the spring's frequency [s].
    """

    spacing: float = 0.08
    time_constant: float = 0.03

    def __post_init__(self) -> None:
        check_numbers(self, "spacing", "time_constant")

    def prepare(self, assembly: Assembly, inverse_mass: Array) -> Prepared:
        """Divides every garment into patches."""
        shares = _partition(assembly.rest, assembly.faces, assembly.parts, self.spacing)
        means = shares.T.multiply(assembly.mass[None]).tocsr()
        means = sp.diags(1.0 / np.asarray(means.sum(axis=1)).ravel()) @ means
        index, weight = pad_rows(means)
        back, back_weight = pad_rows(shares)
        return PreparedGuide(
            jnp.asarray(index),
            float32(weight),
            jnp.asarray(back),
            float32(back_weight),
            jnp.float32(self.time_constant),
        )


@pytree
@dataclasses.dataclass(frozen=True)
class GuideState:
    """Where patches are drawn to in a frame.

    Attributes:
        start: Means at the frame's start [m], shape [patches, 3, batch].
        end: Means at its end [m].
        begins: When the frame starts [s].
        length: Length of the frame [s].
        on: 1 if there is anything to be drawn to, else 0.
    """

    start: Float[Array, "patches 3 batch"]
    end: Float[Array, "patches 3 batch"]
    begins: Float[Array, ""]
    length: Float[Array, ""]
    on: Float[Array, ""]


@pytree
@dataclasses.dataclass(frozen=True)
class PreparedGuide(Prepared):
    """The patches of a scene's cloth.

    Attributes:
        index: Vertices of each patch, shape [patches, k].
        weight: Their shares of its mean, shape [patches, k].
        back: Patches of each vertex, shape [vertices, m].
        back_weight: Their shares of its correction, shape [vertices, m].
        time_constant: See `Guide` [s].
    """

    index: Int[Array, "patches k"]
    weight: Float[Array, "patches k"]
    back: Int[Array, "vertices m"]
    back_weight: Float[Array, "vertices m"]
    time_constant: Float[Array, ""]

    def means(self, values: Float[Array, "vertices 3 batch"]) -> Float[Array, "patches 3 batch"]:
        """Means of vertices over the patches."""
        return jnp.einsum("pk,pkcb->pcb", self.weight, values[self.index])

    def receive(
        self, state: GuideState, guide: tuple[Array, Array], begins: Array, length: float
    ) -> GuideState:
        one = jnp.ones((), guide[0].dtype)
        return GuideState(*guide, begins.astype(one.dtype), one * length, one)

    def init_state(self, batch: int) -> GuideState:
        zero = jnp.zeros((len(self.index), 3, batch), self.weight.dtype)
        none = jnp.zeros((), zero.dtype)
        return GuideState(zero, zero, none, none + 1.0, none)

    def update_state(self, context: Any) -> GuideState:
        return context[0]

    def begin(
        self, base: Array, start: Any, end: Any, clock: Clock, state: GuideState
    ) -> tuple[GuideState, Array, Array, Array]:
        first = (clock.time - state.begins) / state.length
        way = state.end - state.start
        begin = state.start + first * way - self.means(base)
        part = clock.length / state.length
        return state, begin, part * way, jnp.asarray(clock.length, base.dtype)

    def project(
        self,
        displacement: Array,
        start: Array,
        context: tuple[GuideState, Array, Array, Array],
        progress: Array,
        step: Step,
    ) -> Array:
        state, begin, way, length = context
        # One implicit step of a critically damped spring on each mean; the length for implicit
        # formulas isn't that of the substep for BDF2.
        r = step.length / self.time_constant
        substep = step.share * length
        away = begin + progress * way - self.means(displacement)
        slower = (step.share * way - self.means(displacement - start)) * (step.length / substep)
        pull = (r * r * away + 2.0 * r * slower) / (1.0 + 2.0 * r + r * r)
        return displacement + state.on * _combine(pull, self.back, self.back_weight)


def _combine(values: Array, index: Array, weight: Array) -> Array:
    out = jnp.zeros((), values.dtype)
    for k in range(index.shape[1]):
        out = out + weight[:, k, None, None] * values[index[:, k]]
    return out


def _partition(
    rest: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    parts: tuple[int, ...],
    spacing: float,
) -> sp.csr_matrix:
    """Shares of patches in vertices, which sum to 1: smooth along the cloth."""
    edges = mesh_edges(faces).vertices
    length = np.linalg.norm(rest[edges[:, 0]] - rest[edges[:, 1]], axis=1)
    graph = sp.csr_matrix(
        (np.maximum(length, 1e-9), (edges[:, 0], edges[:, 1])), (len(rest), len(rest))
    )
    rows, columns, weights, count = [], [], [], 0
    for first, last in zip(parts, parts[1:]):
        # Farthest points: each new middle lies where the others are farthest.
        own = graph[first:last, first:last]
        found, nearest = [], np.full(last - first, np.inf)
        while nearest.max() > spacing:
            far = dijkstra(own, directed=False, indices=int(nearest.argmax()), limit=4.0 * spacing)
            found.append(far)
            nearest = np.minimum(nearest, far)
        distance = np.stack(found, axis=1)
        chosen = np.argsort(distance, axis=1, kind="stable")[:, :_SHARED]
        near = np.take_along_axis(distance, chosen, axis=1)
        share = np.exp(-((near / (_WIDTH * spacing)) ** 2))
        share /= share.sum(axis=1, keepdims=True)
        rows.append(np.repeat(np.arange(first, last), chosen.shape[1]))
        columns.append(count + chosen.ravel())
        weights.append(share.ravel())
        count += distance.shape[1]
    matrix = sp.csr_matrix(
        (np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns))),
        (len(rest), count),
    )
    matrix.eliminate_zeros()
    return matrix
