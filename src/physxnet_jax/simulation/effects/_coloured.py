"""Constraints in colours that share no vertex: one Gauss-Seidel sweep, and their energy."""

import abc
import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ...geometry import greedy_colours
from ...typing import pytree
from .._assembly import float32
from .._effect import Clock, Prepared

# What one more loop counts, as a share of all elements: its program is compiled, too.
_LOOP = 0.12
# Of its length at rest, below which a span has no direction.
_COLLAPSED = 1e-4


@jax.custom_jvp
def directed(span: Float[Array, "members 3 batch"], rest: Any) -> Float[Array, "members 3 batch"]:
    """Spans as they are; a collapsed one has no derivative, as it has no direction.

    Below a ten-thousandth of its length at rest the direction of a span is noise, and what
    it changes by grows without bound from sweep to sweep.

    Args:
        span: From one end to the other.
        rest: Their lengths at rest.
    """
    del rest
    return span


@directed.defjvp
def _directed_jvp(primals: tuple[Array, Any], tangents: tuple[Any, Any]) -> tuple[Array, Array]:
    (span, rest), (change, _) = primals, tangents
    length = jnp.sum(span * span, axis=1, keepdims=True)
    return span, jnp.where(length > (_COLLAPSED * rest) ** 2, change, jnp.zeros_like(change))


@pytree
@dataclasses.dataclass(frozen=True)
class Sheaf:
    """Successive colours of about one size, so that one loop runs over them.

    A colour of fewer elements is filled up with its first one; what that gives is dropped.

    Attributes:
        member: Elements of each colour.
        target: Their corners; beyond the last vertex for fillers.
    """

    member: Int[Array, "colours members"]
    target: tuple[Int[Array, "colours members"], ...]


def sheaves(
    elements: Int[np.ndarray, "elements k"], num_vertices: int
) -> tuple[Int[np.ndarray, " elements"], tuple[Sheaf, ...]]:
    """Elements in the order of their colours, and the loops over these.

    A Gauss-Seidel sweep goes through the colours in turn. Written out it would be a long
    program, one for each colour; as one loop it would mostly work on fillers.

    Args:
        elements: Corners of each element.
        num_vertices: Of the scene.

    Returns:
        An order of the elements, and sheaves that count in it.
    """
    colours = [c for c in greedy_colours(elements, num_vertices) if len(c)]
    order = np.concatenate([np.zeros(0, np.int32), *colours])
    first = np.cumsum([0, *(len(c) for c in colours)])
    out = []
    for i, j in _runs([len(c) for c in colours]):
        size = max(len(c) for c in colours[i:j])
        at = np.arange(size)
        member = [np.where(at < len(colours[k]), first[k] + at, first[k]) for k in range(i, j)]
        filler = np.stack([at >= len(colours[k]) for k in range(i, j)])
        corners = elements[order[np.stack(member)]]
        # No index may occur twice, not even one that is dropped.
        beyond = num_vertices + np.arange(size)[:, None] * corners.shape[2]
        beyond = beyond + np.arange(corners.shape[2])
        target = np.where(filler[..., None], beyond, corners).astype(np.int32)
        out.append(
            Sheaf(
                jnp.asarray(np.stack(member).astype(np.int32)),
                tuple(jnp.asarray(target[..., c]) for c in range(corners.shape[2])),
            )
        )
    return order, tuple(out)


def _runs(sizes: list[int]) -> list[tuple[int, int]]:
    """Successive colours put together: few runs, little to fill up."""
    least = [0.0]
    begin: list[int] = []
    for j in range(1, len(sizes) + 1):
        costs = [least[i] + max(sizes[i:j]) * (j - i) + _LOOP * sum(sizes) for i in range(j)]
        begin.append(int(np.argmin(costs)))
        least.append(costs[begin[-1]])
    out = []
    j = len(sizes)
    while j:
        out.append((begin[j - 1], j))
        j = begin[j - 1]
    return out[::-1]


def bundled(parts: tuple[Sheaf, ...], index: tuple[Array, ...], known: Any) -> tuple[Any, ...]:
    """For each sheaf what `sweep` needs: corners read and written, and what is known.

    Args:
        parts: Sheaves.
        index: Corners of all elements in the sheaves' order.
        known: Of each of these elements (a pytree, elements leading).
    """
    return tuple(
        (*jax.tree.map(lambda x, s=s: x[s.member], (index, known)), s.target) for s in parts
    )


def sweep(
    displacement: Array,
    bundles: tuple[Any, ...],
    move: Callable[[list[Array], Any], list[Array]],
) -> Array:
    """One colour after another: rows are read, moved and written back.

    Args:
        displacement: Shape [vertices, 3, batch].
        bundles: Of `bundled`.
        move: From rows of every corner, shapes [members, 3, batch], and what is known of
            the members to the rows moved.
    """

    def one(d: Array, colour: tuple) -> tuple[Array, None]:
        index, known, target = colour
        # Corner by corner: XLA computes what one scatter of all writes anew for each row.
        for at, rows in zip(target, move([d[i] for i in index], known), strict=True):
            d = d.at[at].set(rows, mode="drop", unique_indices=True)
        return d, None

    for bundle in bundles:
        displacement = jax.lax.scan(one, displacement, bundle)[0]
    return displacement


def corner_pairs(index: tuple[Int[Array, " members"], ...]) -> Int[np.ndarray, "blocks 2"]:
    """Every ordered pair of corners of every element, pair by pair."""
    corners = [np.asarray(i) for i in index]
    return np.concatenate([np.column_stack([a, b]) for a in corners for b in corners])


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
    """Elements in the order of their colours.

    Attributes:
        index: Corners of each element, one array a corner, shape [members].
        weight: Their inverse masses [1/kg], shapes [members, 1, 1].
        law: What the effect knows of them, arrays of shape [members, 1, 1].
        sheaves: Loops over their colours.
    """

    index: tuple[Int[Array, " members"], ...]
    weight: tuple[Float[Array, "members 1 1"], ...]
    law: Any
    sheaves: tuple[Sheaf, ...]


def column(x: Float[np.ndarray, " members"]) -> Float[Array, "members 1 1"]:
    """Numbers of elements, ready to be multiplied with rows."""
    return float32(x[:, None, None])


def colour_group(
    elements: Int[np.ndarray, "elements k"],
    inverse_mass: Float[np.ndarray, " vertices"],
    law: dict[str, Float[np.ndarray, " elements"]],
) -> Group:
    """Elements split by greedy colouring.

    Args:
        elements: Corners of each element.
        inverse_mass: [1/kg].
        law: Values of each element.
    """
    order, parts = sheaves(elements, len(inverse_mass))
    corners = elements[order].T
    return Group(
        tuple(jnp.asarray(c.astype(np.int32)) for c in corners),
        tuple(column(inverse_mass[c]) for c in corners),
        {k: column(v[order]) for k, v in law.items()},
        parts,
    )


class Coloured(Prepared, abc.ABC):
    """An effect made of scalar constraints: say `measure`, and the rest follows.

    Corners are handed over relative to the first one and built from differences, so
    that float32 stays exact far from the origin.
    """

    elastic = True
    group: Group

    @abc.abstractmethod
    def measure(self, law: Any, corners: tuple[Array, ...]) -> list[Any]:
        """Functions that give each `Constraint` of a group in turn, from its corners."""

    def begin(self, base: Array, start: Any, end: Any, clock: Clock, memory: Any) -> tuple:
        g = self.group
        edges = tuple(base[i] - base[g.index[0]] for i in g.index[1:])
        return edges, bundled(g.sheaves, g.index, (g.weight, g.law, edges))

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

        def move(rows: list[Array], known: tuple) -> list[Array]:
            weight, law, edges = known
            for constraint in self.measure(law, self._corners(rows, edges)):
                c = constraint(self._corners(rows, edges))
                inertia = sum(
                    w * jnp.sum(n * n, axis=1, keepdims=True)
                    for w, n in zip(weight, c.gradients, strict=True)
                )
                resists = inertia + c.compliance / (h * h)
                # Rigid, and all its corners held: nothing moves, and no derivative divides by it.
                moves = resists > 0
                step = jnp.where(moves, -c.value / jnp.where(moves, resists, 1.0), 0.0)
                rows = [r + w * step * n for r, w, n in zip(rows, weight, c.gradients, strict=True)]
            return rows

        return sweep(displacement, context[1], move)

    def energy(self, displacement: Array, context: tuple) -> Array | None:
        g = self.group
        total = jnp.zeros(displacement.shape[2:], displacement.dtype)
        corners = self._corners([displacement[i] for i in g.index], context[0])
        for law in self.measure(g.law, corners):
            c = law(corners)
            total = total + 0.5 * jnp.sum(c.value**2 / c.compliance, axis=(0, 1))
        return total

    def coupled(self) -> Int[np.ndarray, "blocks 2"]:
        return corner_pairs(self.group.index)

    def hessian(self, displacement: Array, context: tuple) -> Array | None:
        """Gauss-Newton blocks: stiffness times outer products of the gradients."""
        g = self.group
        if not g.sheaves:
            return None
        corners = self._corners([displacement[i] for i in g.index], context[0])
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
