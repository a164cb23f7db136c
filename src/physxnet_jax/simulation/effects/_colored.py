"""Coloured constraints: Gauss-Seidel sweeps colour by colour, energy and Hessian."""

import abc
import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ...geometry import greedy_coloring
from ...typing import pytree
from .._assembly import float32
from .._effect import Clock, Prepared, Rest, Step

# Cost of one more loop, including its compilation, as a share of all elements.
_LOOP = 0.12
# Share of its rest length below which a span has no direction.
_COLLAPSED = 1e-4


@jax.custom_jvp
def directed(span: Float[Array, "members 3 batch"], rest: Any) -> Float[Array, "members 3 batch"]:
    """Returns the spans unchanged; the derivative of a collapsed span is zero.

    Below a ten-thousandth of its rest length the direction of a span is noise, and
    derivatives through it would grow without bound from sweep to sweep.

    Args:
        span: Vectors from one end to the other.
        rest: Their rest lengths.
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
class ColorGroup:
    """Successive colours of similar size, processed by one loop.

    Smaller colours are padded with their first element; the results of padding are dropped.

    Attributes:
        member: Elements of each colour.
        target: Corners of the elements; beyond the last vertex for padding.
    """

    member: Int[Array, "colours members"]
    target: tuple[Int[Array, "colours members"], ...]


def color_groups(
    elements: Int[np.ndarray, "elements k"], num_vertices: int
) -> tuple[Int[np.ndarray, " elements"], tuple[ColorGroup, ...]]:
    """Orders elements by colour and groups the colours into loops.

    A Gauss-Seidel sweep processes the colours one after another. Unrolled, the program
    would grow with the number of colours; as one loop it would mostly process padding.

    Args:
        elements: Corners of each element.
        num_vertices: Number of vertices in the scene.

    Returns:
        The order of the elements, and colour groups that index into this order.
    """
    colours = [c for c in greedy_coloring(elements, num_vertices) if len(c)]
    order = np.concatenate([np.zeros(0, np.int32), *colours])
    first = np.cumsum([0, *(len(c) for c in colours)])
    out = []
    for i, j in _runs([len(c) for c in colours]):
        size = max(len(c) for c in colours[i:j])
        at = np.arange(size)
        member = [np.where(at < len(colours[k]), first[k] + at, first[k]) for k in range(i, j)]
        filler = np.stack([at >= len(colours[k]) for k in range(i, j)])
        corners = elements[order[np.stack(member)]]
        # Indices must be unique, even those that are dropped.
        beyond = num_vertices + np.arange(size)[:, None] * corners.shape[2]
        beyond = beyond + np.arange(corners.shape[2])
        target = np.where(filler[..., None], beyond, corners).astype(np.int32)
        out.append(
            ColorGroup(
                jax.device_put(np.stack(member).astype(np.int32)),
                tuple(jax.device_put(target[..., c]) for c in range(corners.shape[2])),
            )
        )
    return order, tuple(out)


def _runs(sizes: list[int]) -> list[tuple[int, int]]:
    """Ranges of successive colours that minimise the cost of loops and padding."""
    best_cost = [0.0]
    begin: list[int] = []
    for j in range(1, len(sizes) + 1):
        costs = [best_cost[i] + max(sizes[i:j]) * (j - i) + _LOOP * sum(sizes) for i in range(j)]
        begin.append(int(np.argmin(costs)))
        best_cost.append(costs[begin[-1]])
    out = []
    j = len(sizes)
    while j:
        out.append((begin[j - 1], j))
        j = begin[j - 1]
    return out[::-1]


def bundled(parts: tuple[ColorGroup, ...], index: tuple[Array, ...], known: Any) -> tuple[Any, ...]:
    """Inputs of `sweep` for each colour group: corners to read, data, corners to write.

    Args:
        parts: Colour groups.
        index: Corners of all elements, in the order of the colour groups.
        known: Data of these elements (a pytree with elements as the first axis).
    """
    return tuple(
        (*jax.tree.map(lambda x, s=s: x[s.member], (index, known)), s.target) for s in parts
    )


def sweep(
    displacement: Array,
    bundles: tuple[Any, ...],
    move: Callable[[list[Array], Any], list[Array]],
) -> Array:
    """Reads, moves and writes the rows of one colour after another.

    Args:
        displacement: Displacements [m], shape [vertices, 3, batch].
        bundles: Result of `bundled`.
        move: Maps the rows of each corner, shapes [members, 3, batch], and the members'
            data to the moved rows.
    """

    def one(d: Array, colour: tuple) -> tuple[Array, None]:
        index, known, target = colour
        # One scatter per corner: XLA would recompute the updates of a joint one for each row.
        for at, rows in zip(target, move([d[i] for i in index], known), strict=True):
            d = d.at[at].set(rows, mode="drop", unique_indices=True)
        return d, None

    for bundle in bundles:
        displacement = jax.lax.scan(one, displacement, bundle)[0]
    return displacement


def corner_pairs(index: tuple[Int[Array, " members"], ...]) -> Int[np.ndarray, "blocks 2"]:
    """All ordered pairs of corners of all elements, grouped by corners."""
    corners = [np.asarray(i) for i in index]
    return np.concatenate([np.column_stack([a, b]) for a in corners for b in corners])


class Constraint(NamedTuple):
    """One scalar constraint of each member of a group.

    Attributes:
        value: Constraint value C, shape [members, 1, batch].
        gradients: Gradients of C with respect to the corners, shapes [members, 3, batch].
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
        index: Corners of each element, one array per corner, shapes [members].
        weight: Inverse masses of the corners [1/kg], shapes [members, 1, 1].
        law: The effect's parameters of the elements, arrays of shape [members, 1, 1].
        color_groups: Colour groups of the elements.
    """

    index: tuple[Int[Array, " members"], ...]
    weight: tuple[Float[Array, "members 1 1"], ...]
    law: Any
    color_groups: tuple[ColorGroup, ...]

    def reshaped(self, rest: Rest, law: Any) -> "Group":
        """The elements with the masses of another rest state, and another law."""
        weight = tuple(rest.inverse_mass[i][:, None, None] for i in self.index)
        return dataclasses.replace(self, weight=weight, law=law)


def column(x: Float[np.ndarray, " members"]) -> Float[Array, "members 1 1"]:
    """Reshapes values of elements so that they broadcast against rows."""
    return float32(x[:, None, None])


def color_constraints(
    elements: Int[np.ndarray, "elements k"],
    inverse_mass: Float[np.ndarray, " vertices"],
    law: dict[str, Float[np.ndarray, " elements"]],
) -> Group:
    """Colours elements greedily.

    Args:
        elements: Corners of each element.
        inverse_mass: Inverse masses of the vertices [1/kg].
        law: Parameters of each element.
    """
    order, parts = color_groups(elements, len(inverse_mass))
    corners = elements[order].T
    return Group(
        tuple(jax.device_put(c.astype(np.int32)) for c in corners),
        tuple(column(inverse_mass[c]) for c in corners),
        {k: column(v[order]) for k, v in law.items()},
        parts,
    )


class Colored(Prepared, abc.ABC):
    """Base class of effects made of scalar constraints; subclasses implement `measure`.

    Corners are passed relative to the first one and built from differences, so that
    float32 stays accurate far from the origin.
    """

    elastic = True
    group: Group

    @abc.abstractmethod
    def measure(self, law: Any, corners: tuple[Array, ...]) -> list[Any]:
        """Functions from corners to the `Constraint` values of a group, applied in turn."""

    def begin(self, base: Array, start: Any, end: Any, clock: Clock, state: Any) -> tuple:
        g = self.group
        edges = tuple(base[i] - base[g.index[0]] for i in g.index[1:])
        return edges, bundled(g.color_groups, g.index, (g.weight, g.law, edges))

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
        step: Step,
    ) -> Array:
        h = step.length

        def move(rows: list[Array], known: tuple) -> list[Array]:
            weight, law, edges = known
            for constraint in self.measure(law, self._corners(rows, edges)):
                c = constraint(self._corners(rows, edges))
                inertia = sum(
                    w * jnp.sum(n * n, axis=1, keepdims=True)
                    for w, n in zip(weight, c.gradients, strict=True)
                )
                denominator = inertia + c.compliance / (h * h)
                # Zero for a rigid constraint with all corners held: don't divide by it.
                moves = denominator > 0
                step = jnp.where(moves, -c.value / jnp.where(moves, denominator, 1.0), 0.0)
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
        if not g.color_groups:
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
