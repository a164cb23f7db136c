"""Guide: patch means of the cloth are drawn to where a prediction has them."""

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
from ...geometry import materialize, pad_rows, patch_shares
from ...typing import pytree
from .._assembly import Assembly, float32, norm
from .._effect import Clock, Effect, Prepared, Rest, Step

# Vertices over which the mean of a patch is taken.
_MEMBERS = 128
# Largest factor by which the way from a patch to the next above is lengthened [1].
_LENGTHENED = 1.1


@dataclasses.dataclass(frozen=True)
class Guide(Effect):
    """Draws the means of patches to given positions; folds within a patch are left to the cloth.

    Positions are given to `advance` frame by frame; without them nothing is drawn. Each mean hangs
    on a critically damped spring, whose stiffness doesn't depend on the substep. What hangs of
    skirts is drawn less: where it swings depends on what happened before.

    Attributes:
        spacing: Distance between the middles of patches along the cloth [m].
        time_constant: Inverse of the spring's frequency [s].
        hanging: Share of the pull on what hangs [1].
    """

    spacing: float = 0.08
    time_constant: float = 0.03
    hanging: float = 0.4

    def __post_init__(self) -> None:
        check_numbers(self, "spacing", "time_constant")
        check_numbers(self, "hanging", zero=True)

    def prepare(self, assembly: Assembly, inverse_mass: Array) -> Prepared:
        """Divides every garment into patches."""
        parts = [
            patch_shares(assembly.rest[a:b], faces_between(assembly.faces, a, b), self.spacing)
            for a, b in itertools.pairwise(assembly.parts)
        ]
        shares = sp.csr_matrix(sp.block_diag(parts))
        weights = shares.T.multiply(assembly.mass[None]).tocsr()
        index, weight = _thinned(*pad_rows(weights))
        back, back_weight = pad_rows(shares)
        hung = None
        if assembly.hanging.any():
            share = (weights @ assembly.hanging) / np.asarray(weights.sum(axis=1))[:, 0]
            means = np.einsum("pk,pkc->pc", weight, assembly.rest[index])
            above = _patch_above(means, shares, share)
            hung = Hung(
                float32(1.0 - (1.0 - self.hanging) * share),
                jax.device_put(above),
                float32(_all_above(above)),
                float32(np.linalg.norm(means - means[above], axis=1)),
            )
        return PreparedGuide(
            jax.device_put(index),
            float32(weight),
            jax.device_put(np.ascontiguousarray(back.T)),
            float32(np.ascontiguousarray(back_weight.T)),
            hung,
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
class Hung:
    """What hangs of a scene's cloth.

    Attributes:
        hold: Share of the pull on each patch, shape [patches].
        above: The patch from which each hangs, itself if it is snug, shape [patches].
        all_above: 1 for a patch itself and all that it hangs from, one by one, else 0; shape
            [patches, patches].
        length: Distance from the patch above at rest [m], shape [patches].
    """

    hold: Float[Array, " patches"]
    above: Int[Array, " patches"]
    all_above: Float[Array, "patches patches"]
    length: Float[Array, " patches"]


@pytree
@dataclasses.dataclass(frozen=True)
class PreparedGuide(Prepared):
    """The patches of a scene's cloth.

    Attributes:
        index: Vertices that stand for each patch, shape [patches, k].
        weight: Their shares of its mean, shape [patches, k].
        back: Patches of each vertex, shape [m, vertices].
        back_weight: Their shares of its correction, shape [m, vertices].
        hung: What hangs; None if nothing does.
        time_constant: See `Guide` [s].
    """

    index: Int[Array, "patches k"]
    weight: Float[Array, "patches k"]
    back: Int[Array, "m vertices"]
    back_weight: Float[Array, "m vertices"]
    hung: Hung | None
    time_constant: Float[Array, ""]

    def means(self, values: Float[Array, "vertices n batch"]) -> Float[Array, "patches n batch"]:
        """Means of vertices over the patches."""
        return jnp.einsum("pk,pkcb->pcb", self.weight, values[self.index])

    def lengthened(self, means: Float[Array, "patches n batch"]) -> Float[Array, "patches n batch"]:
        """Means moved away from the patches that they hang from, as far as they were at rest.

        A prediction, as a mean over how cloth may swing, has it shorter than it ever is: drawn
        there, it would crumple.
        """
        if self.hung is None:
            return means
        way = means - means[self.hung.above]
        far = norm(jnp.moveaxis(way, 1, -1))
        some = far > 0.0
        scale = jnp.where(some, self.hung.length[:, None] / jnp.where(some, far, 1.0), 1.0)
        more = (jnp.clip(scale, 1.0, _LENGTHENED) - 1.0)[:, None] * way
        return means + jnp.einsum("pq,qcb->pcb", self.hung.all_above, more)

    def held(self, moves: Float[Array, "patches n batch"]) -> Float[Array, "patches n batch"]:
        """The share of moves that is left to patches which hang; all of the others."""
        return moves if self.hung is None else self.hung.hold[:, None, None] * moves

    def spread(self, moves: Float[Array, "patches 3 batch"]) -> Float[Array, "vertices 3 batch"]:
        """Moves of patches, interpolated at the vertices."""
        share = self.back_weight[..., None, None]
        return jnp.sum(share * materialize(moves)[self.back], axis=0)

    def reshaped(self, rest: Rest) -> Prepared:
        # Patches are of vertices, and weigh them as they were.
        if self.hung is None:
            return self
        means = self.means(rest.cloth[:, :, None])[..., 0]
        length = norm(means - means[self.hung.above])
        return dataclasses.replace(self, hung=dataclasses.replace(self.hung, length=length))

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
        # Both means at once: what costs is the reading of rows.
        moved = self.means(jnp.concatenate([displacement, displacement - start], axis=1))
        at, gone = moved[:, :3], moved[:, 3:]
        away = begin + progress * way - at
        slower = (step.share * way - gone) * (step.length / substep)
        pull = (r * r * away + 2.0 * r * slower) / (1.0 + 2.0 * r + r * r)
        return displacement + state.on * self.spread(self.held(pull))


def _patch_above(
    means: Float[np.ndarray, "patches 3"],
    shares: sp.csr_matrix,
    share: Float[np.ndarray, " patches"],
) -> Int[np.ndarray, " patches"]:
    """The next patch on the way along the cloth to where it is snug, from each patch that hangs.

    Args:
        means: Means of patches at rest [m].
        shares: Of patches in vertices; patches that share a vertex are neighbours.
        share: Share of each patch that hangs.

    Returns:
        Patches; a snug one has itself, as has one from which nothing snug is reached.
    """
    itself = np.arange(len(means))
    snug = np.flatnonzero(share <= 0.5)
    if not len(snug):
        return itself
    near = sp.triu(shares.T @ shares, 1).tocoo()
    far = np.linalg.norm(means[near.row] - means[near.col], axis=1)
    graph = sp.csr_matrix((far, (near.row, near.col)), (len(means), len(means)))
    _, before, _ = dijkstra(
        graph, directed=False, indices=snug, min_only=True, return_predecessors=True
    )
    return np.where(before < 0, itself, before)


def _all_above(above: Int[np.ndarray, " patches"]) -> Float[np.ndarray, "patches patches"]:
    """For each patch a row of ones for itself and all from which it hangs, else zeros."""
    held = np.zeros((len(above), len(above)))
    rows = at = np.arange(len(above))
    while (held[rows, at] == 0.0).any():
        held[rows, at] = 1.0
        at = above[at]
    return held


def _thinned(
    index: Int[np.ndarray, "patches n"], weight: Float[np.ndarray, "patches n"]
) -> tuple[Int[np.ndarray, "patches k"], Float[np.ndarray, "patches k"]]:
    """At most so many vertices of each patch: the others would hardly change its mean."""
    size = min(_MEMBERS, index.shape[1])
    kept, share = np.zeros((len(index), size), index.dtype), np.zeros((len(index), size))
    # Drawn at random, since any regular choice can be in step with the mesh.
    rng = np.random.default_rng(0)
    for row, count in enumerate((weight > 0).sum(axis=1)):
        drawn = rng.permutation(count)[:size]
        kept[row, : len(drawn)] = index[row, drawn]
        share[row, : len(drawn)] = weight[row, drawn]
    return kept, share / share.sum(axis=1, keepdims=True)


def faces_between(
    faces: Int[np.ndarray, "faces 3"], first: int, last: int
) -> Int[np.ndarray, "some 3"]:
    """The faces of one garment, with vertices counted from its first."""
    return faces[(faces[:, 0] >= first) & (faces[:, 0] < last)] - first
