"""Lengths that cloth keeps: points moved until the edges of a mesh are as long as at rest."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Float, Int

from ..typing import pytree
from ._rotation import safe_norm
from ._topology import hinges, mesh_edges

# Share of the pull by springs across edges, which resist folding, beside those along edges.
_ACROSS = 0.25
# Steps go on in the direction of the last one by this much (Nesterov). A step takes at most
# 2 * 0.625 of what is too much; above 1.4 it would swing with this momentum.
_MOMENTUM = 0.7
# A spring pushes as if it weren't shorter than this share of its length: where points
# coincide neither a step nor its derivative is large.
_SHORTEST = 0.5
# Of a vertex with more springs every so many are taken.
_MOST = 40


@pytree
@dataclasses.dataclass(frozen=True)
class Springs:
    """For every row the rows it is tied to; in two groups, by how many these are.

    Attributes:
        order: Rows, the groups one after the other, shape [rows].
        back: Where each row is in that order, shape [rows].
        index: Of each group, what its members are tied to, in that order, shape
            [k, members]; themselves where they have fewer.
        weight: How much each tie counts, at most about 0.6 in all, shape [k, members].
        length: Length at rest [m], shape [k, members].
    """

    order: Int[Array, " rows"]
    back: Int[Array, " rows"]
    index: tuple[Int[Array, "k members"], ...]
    weight: tuple[Float[Array, "k members"], ...]
    length: tuple[Float[Array, "k members"], ...]

    def at_rest(self, points: Float[Array, "rows 3"]) -> "Springs":
        """The same springs with the lengths they have between these points [m]; pure."""
        rows = points[self.order]
        lengths = []
        for start, index in zip(self.starts, self.index, strict=True):
            lengths.append(safe_norm(rows[index] - rows[None, start : start + index.shape[1]]))
        return dataclasses.replace(self, length=tuple(lengths))

    @property
    def starts(self) -> list[int]:
        """Where each group begins in the order of rows."""
        return np.cumsum([0, *(i.shape[1] for i in self.index[:-1])]).tolist()


def make_springs(
    vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> Springs:
    """Springs along the edges of a mesh, and across them between opposite corners.

    Args:
        vertices: Positions at rest [m].
        faces: Triangles.

    Returns:
        The springs. Each vertex is moved by half the mean of what its edges ask for, and a
        quarter of the same of what is across them; one without an edge isn't moved.
    """
    count = len(vertices)
    # A triangle that names a corner twice is none, and must not part what lies beside it.
    sides = faces[:, [0, 1, 2]] != faces[:, [1, 2, 0]]
    faces = faces[sides.all(axis=1)]
    ties = sp.csr_matrix((count, count))
    for ends, share in ((mesh_edges(faces).vertices, 0.5), (hinges(faces)[:, 2:], 0.5 * _ACROSS)):
        # Across an edge of two faces that are one there is nothing.
        ends = ends[ends[:, 0] != ends[:, 1]]
        mine, other = ends.ravel(), ends[:, ::-1].ravel()
        number = np.bincount(mine, minlength=count)
        ties = ties + sp.csr_matrix((share / number[mine], (mine, other)), (count, count))
    ties = _thinned(ties)
    degree = np.diff(ties.indptr)
    order = np.argsort(degree, kind="stable").astype(np.int32)
    back = np.argsort(order).astype(np.int32)
    index, weight, length = [], [], []
    for start, stop in _groups(degree[order]):
        members = order[start:stop]
        slot = np.arange(max(int(degree[members].max(initial=0)), 1))[:, None]
        taken = slot < degree[members]
        entry = np.where(taken, ties.indptr[members] + slot, 0)
        here = np.arange(start, stop, dtype=np.int32)
        index.append(np.where(taken, back[_at(ties.indices, entry)], here).astype(np.int32))
        weight.append(np.where(taken, _at(ties.data, entry), 0.0).astype(np.float32))
        away = vertices[order[index[-1]]] - vertices[members]
        length.append(np.linalg.norm(away, axis=2).astype(np.float32))
    return Springs(
        jnp.asarray(order),
        jnp.asarray(back),
        tuple(map(jnp.asarray, index)),
        tuple(map(jnp.asarray, weight)),
        tuple(map(jnp.asarray, length)),
    )


def _at(values: np.ndarray, entry: np.ndarray) -> np.ndarray:
    # A mesh without any edge has no entries at all.
    return values[entry] if len(values) else np.zeros(entry.shape, values.dtype)


def _thinned(ties: sp.csr_matrix) -> sp.csr_matrix:
    """At most so many ties of each row, which count as much together as all did."""
    degree = np.diff(ties.indptr)
    if degree.max(initial=0) <= _MOST:
        return ties
    slot = np.arange(ties.nnz) - np.repeat(ties.indptr[:-1], degree)
    step = np.maximum(np.repeat(degree, degree) / _MOST, 1.0)
    # The first of each run of so many.
    keep = np.floor(slot / step) != np.floor((slot - 1) / step)
    thin = ties.copy()
    thin.data = np.where(keep, ties.data, 0.0)
    thin.eliminate_zeros()
    whole, left = (np.asarray(m.sum(axis=1)).ravel() for m in (ties, thin))
    return sp.csr_matrix(sp.diags(whole / np.maximum(left, 1e-12)) @ thin)


def _groups(degree: Int[np.ndarray, " rows"]) -> list[tuple[int, int]]:
    """Where to part rows, sorted by how many springs they have: as little to fill up as can be."""
    count = len(degree)
    cuts = np.flatnonzero(np.diff(degree)) + 1
    if not len(cuts):
        return [(0, count)]
    filled = cuts * degree[cuts - 1] + (count - cuts) * degree[-1]
    cut = int(cuts[np.argmin(filled)])
    return [(0, cut), (cut, count)]


def relax(springs: Springs, points: Float[Array, "rows 3"], steps: int) -> Float[Array, "rows 3"]:
    """Points moved towards the lengths of their springs; pure, differentiable.

    What is stretched draws together, what is pressed together folds. Few steps mend
    neighbourhoods and leave the whole where it was.

    Args:
        springs: From `make_springs`.
        points: Positions [m].
        steps: How often every point is moved; with 0 nothing is computed.

    Returns:
        The points [m]. Where they were doesn't matter to them: turned or moved as a whole
        they come out turned or moved.

    References:
        Macklin et al., Unified particle physics for real-time applications (2014), for
        averaged Jacobi projections; Müller and Chentanez, Wrinkle meshes (2010), for
        folds by projection of a few lengths.

    Example:
        >>> import numpy as np
        >>> square = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], np.float32)
        >>> springs = make_springs(square, np.array([[0, 1, 2], [2, 1, 3]]))
        >>> shrunk = relax(springs, jnp.asarray(1.2 * square), 20)
        >>> bool(abs(jnp.linalg.norm(shrunk[1] - shrunk[0]) - 1) < 0.02)
        True
    """
    if steps == 0:
        return points
    # Far from the origin differences of neighbours would be rounded.
    origin = jax.lax.stop_gradient(points[:1])
    rows = (points - origin)[springs.order]

    def step(carry: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], None]:
        last, before = carry
        ahead = last + _MOMENTUM * (last - before)
        groups = zip(springs.starts, springs.index, springs.weight, springs.length, strict=True)
        return (jnp.concatenate([_pull(ahead, *group) for group in groups]), last), None

    # A gradient computes the inside of a step anew.
    (rows, _), _ = jax.lax.scan(jax.checkpoint(step), (rows, rows), None, length=steps)
    return rows[springs.back] + origin


def _pull(
    rows: Float[Array, "rows 3"],
    start: int,
    index: Int[Array, "k members"],
    weight: Float[Array, "k members"],
    length: Float[Array, "k members"],
) -> Float[Array, "members 3"]:
    mine = rows[start : start + index.shape[1]]

    def tie(out: Array, known: tuple[Array, Array, Array]) -> tuple[Array, None]:
        other, share, rest = known
        away = rows[other] - mine
        squared = jnp.sum(away * away, axis=1)
        # Ties that fill up rows have no length; second derivatives there must stay finite too.
        least = (_SHORTEST * rest) ** 2 + 1e-12
        pull = share * (1.0 - rest * jax.lax.rsqrt(jnp.maximum(squared, least)))
        return out + pull[:, None] * away, None

    # A loop: written out it takes three times as long to compile, and no less to run.
    return jax.lax.scan(tie, mine, (index, weight, length))[0]
