"""Constraints in groups that share no vertex: one Gauss-Seidel sweep, and their energy."""

import abc
import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ...geometry import greedy_colours
from ...typing import pytree
from .._assembly import float32
from .._effect import Clock, Prepared


def scatter_rows(target: Array, index: list[Int[Array, " members"]], rows: list[Array]) -> Array:
    """Rows put back where they were gathered from; no index occurs twice."""
    return target.at[jnp.concatenate(index)].set(jnp.concatenate(rows), unique_indices=True)


def corner_pairs(index: tuple[Int[Array, " members"], ...]) -> Int[np.ndarray, "blocks 2"]:
    """Every ordered pair of corners of every element, pair by pair."""
    corners = [np.asarray(i) for i in index]
    return np.concatenate([np.column_stack([a, b]) for a in corners for b in corners])


def joined(parts: tuple[Any, ...]) -> Any:
    """Groups, or what belongs to them, as one: what sums over all needs no colours."""
    return jax.tree.map(lambda *x: jnp.concatenate(x), *parts)


class Constraint(NamedTuple):
    """One scalar constraint of every member of a group.

    Attributes:
        value: C, shape [members, 1, batch].
        gradients: Its gradient by each corner, shapes [members, 3, batch].
        compliance: 1 / stiffness, shape [members, 1, 1] or [members, 1, batch].
    """

    value: Array
    gradients: tuple[Array, ...]
    compliance: Array


@pytree
@dataclasses.dataclass(frozen=True)
class Group:
    """Elements that share no vertex.

    Attributes:
        index: Corners of each element, one array a corner, shape [members].
        weight: Their inverse masses [1/kg], shapes [members, 1, 1].
        law: What the effect knows of them, arrays of shape [members, 1, 1].
    """

    index: tuple[Int[Array, " members"], ...]
    weight: tuple[Float[Array, "members 1 1"], ...]
    law: Any


def colour_groups(
    elements: Int[np.ndarray, "elements k"],
    inverse_mass: Float[np.ndarray, " vertices"],
    law: dict[str, Float[np.ndarray, " elements"]],
) -> tuple[Group, ...]:
    """Elements split by greedy colouring.

    Args:
        elements: Corners of each element.
        inverse_mass: [1/kg].
        law: Values of each element.
    """
    groups = []
    for members in greedy_colours(elements, len(inverse_mass)):
        corners = elements[members]
        groups.append(
            Group(
                tuple(jnp.asarray(corners[:, i]) for i in range(corners.shape[1])),
                tuple(
                    float32(inverse_mass[corners[:, i]][:, None, None])
                    for i in range(corners.shape[1])
                ),
                {k: float32(v[members][:, None, None]) for k, v in law.items()},
            )
        )
    return tuple(groups)


class Coloured(Prepared, abc.ABC):
    """An effect made of scalar constraints: say `measure`, and the rest follows.

    Corners are handed over relative to the first one and built from differences, so
    that float32 stays exact far from the origin.
    """

    elastic = True
    groups: tuple[Group, ...]

    @abc.abstractmethod
    def measure(self, law: Any, corners: tuple[Array, ...]) -> list[Any]:
        """Functions that give each `Constraint` of a group in turn, from its corners."""

    def begin(self, base: Array, start: Any, end: Any, clock: Clock, memory: Any) -> tuple:
        return tuple(tuple(base[i] - base[g.index[0]] for i in g.index[1:]) for g in self.groups)

    @staticmethod
    def _corners(rows: list[Array], edges: tuple[Array, ...]) -> tuple[Array, ...]:
        return (
            jnp.zeros_like(rows[0]),
            *(e + (r - rows[0]) for e, r in zip(edges, rows[1:], strict=True)),
        )

    def project(
        self,
        displacement: Array,
        start: Array,
        context: tuple,
        progress: Array,
        step: tuple[float, float],
    ) -> Array:
        h = step[0]
        d = displacement
        for g, edges in zip(self.groups, context, strict=True):
            rows = [d[i] for i in g.index]
            for law in self.measure(g.law, self._corners(rows, edges)):
                c = law(self._corners(rows, edges))
                inertia = sum(
                    w * jnp.sum(n * n, axis=1, keepdims=True)
                    for w, n in zip(g.weight, c.gradients, strict=True)
                )
                move = -c.value / (inertia + c.compliance / (h * h) + 1e-20)
                rows = [
                    r + w * move * n for r, w, n in zip(rows, g.weight, c.gradients, strict=True)
                ]
            d = scatter_rows(d, list(g.index), rows)
        return d

    def energy(self, displacement: Array, context: tuple) -> Array | None:
        total = jnp.zeros(displacement.shape[2:], displacement.dtype)
        if not self.groups:
            return total
        g = joined(self.groups)
        corners = self._corners([displacement[i] for i in g.index], joined(context))
        for law in self.measure(g.law, corners):
            c = law(corners)
            total = total + 0.5 * jnp.sum(c.value**2 / c.compliance, axis=(0, 1))
        return total

    def coupled(self) -> Int[np.ndarray, "blocks 2"]:
        none = np.zeros((0, 2), np.int64)
        return corner_pairs(joined(self.groups).index) if self.groups else none

    def hessian(self, displacement: Array, context: tuple) -> Array | None:
        """Gauss-Newton blocks: stiffness times outer products of the gradients."""
        if not self.groups:
            return None
        g = joined(self.groups)
        corners = self._corners([displacement[i] for i in g.index], joined(context))
        sums: dict[tuple[int, int], Array] = {}
        for law in self.measure(g.law, corners):
            c = law(corners)
            n = [jnp.swapaxes(x, 1, 2) for x in c.gradients]
            k = jnp.swapaxes(1.0 / c.compliance, 1, 2)[..., None]
            for a in range(len(n)):
                for b in range(len(n)):
                    block = k * n[a][..., :, None] * n[b][..., None, :]
                    sums[a, b] = sums[a, b] + block if (a, b) in sums else block
        return jnp.concatenate([sums[p] for p in sums])
