"""Strain limiting: points are moved until the edges of a mesh have their rest lengths."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Float, Int

from ..typing import pytree
from ._rotation import safe_norm
from ._topology import hinges, mesh_edges

# Weight of constraints across edges, which resist folding, relative to those along edges.
_BENDING_WEIGHT = 0.25
# Nesterov momentum. A step removes at most 2 * 0.625 of the excess length; above 1.4 it would
# oscillate with this momentum.
_MOMENTUM = 0.7
# Edges count as no shorter than this share of their rest length: where points coincide,
# neither a step nor its derivative is large.
_MIN_LENGTH_RATIO = 0.5
# Maximum number of constraints of a vertex; vertices with more use evenly spaced ones.
_MAX_CONSTRAINTS = 40


@pytree
@dataclasses.dataclass(frozen=True)
class EdgeConstraints:
    """Length constraints of every row, in up to two groups by number of constraints.

    Attributes:
        order: Rows, sorted by group, shape [rows].
        back: Position of each row in ``order``, shape [rows].
        index: For each group, the neighbours of its members as positions in ``order``,
            shape [k, members]; padded with the members themselves.
        weight: Weights, which sum to at most about 0.6 per member, shape [k, members].
        length: Rest lengths [m], shape [k, members].
    """

    order: Int[Array, " rows"]
    back: Int[Array, " rows"]
    index: tuple[Int[Array, "k members"], ...]
    weight: tuple[Float[Array, "k members"], ...]
    length: tuple[Float[Array, "k members"], ...]

    def at_rest(self, points: Float[Array, "rows 3"]) -> "EdgeConstraints":
        """The same constraints with rest lengths measured between these points [m]; pure."""
        rows = points[self.order]
        lengths = []
        for start, index in zip(self.starts, self.index, strict=True):
            lengths.append(safe_norm(rows[index] - rows[None, start : start + index.shape[1]]))
        return dataclasses.replace(self, length=tuple(lengths))

    @property
    def starts(self) -> list[int]:
        """Position in ``order`` of the first member of each group."""
        return np.cumsum([0, *(i.shape[1] for i in self.index[:-1])]).tolist()


def make_edge_constraints(
    vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> EdgeConstraints:
    """Builds constraints along the edges of a mesh and across them, between opposite corners.

    Args:
        vertices: Positions at rest [m].
        faces: Triangles.

    Returns:
        The constraints. A step moves each vertex by half the mean correction of its edges
        and an eighth of the mean correction across edges. Vertices without an edge stay.
    """
    count = len(vertices)
    # Triangles with a repeated corner are dropped: they mustn't separate the faces beside them.
    sides = faces[:, [0, 1, 2]] != faces[:, [1, 2, 0]]
    faces = faces[sides.all(axis=1)]
    adjacency = sp.csr_matrix((count, count))
    for ends, share in (
        (mesh_edges(faces).vertices, 0.5),
        (hinges(faces)[:, 2:], 0.5 * _BENDING_WEIGHT),
    ):
        # Duplicate faces have the same opposite corner: there is nothing to constrain.
        ends = ends[ends[:, 0] != ends[:, 1]]
        mine, other = ends.ravel(), ends[:, ::-1].ravel()
        number = np.bincount(mine, minlength=count)
        adjacency = adjacency + sp.csr_matrix((share / number[mine], (mine, other)), (count, count))
    adjacency = _limit_constraints(adjacency)
    degree = np.diff(adjacency.indptr)
    order = np.argsort(degree, kind="stable").astype(np.int32)
    back = np.argsort(order).astype(np.int32)
    index, weight, length = [], [], []
    for start, stop in _split_by_degree(degree[order]):
        members = order[start:stop]
        slot = np.arange(max(int(degree[members].max(initial=0)), 1))[:, None]
        taken = slot < degree[members]
        entry = np.where(taken, adjacency.indptr[members] + slot, 0)
        here = np.arange(start, stop, dtype=np.int32)
        index.append(np.where(taken, back[_take(adjacency.indices, entry)], here).astype(np.int32))
        weight.append(np.where(taken, _take(adjacency.data, entry), 0.0).astype(np.float32))
        offsets = vertices[order[index[-1]]] - vertices[members]
        length.append(np.linalg.norm(offsets, axis=2).astype(np.float32))
    return EdgeConstraints(
        jax.device_put(order),
        jax.device_put(back),
        tuple(map(jax.device_put, index)),
        tuple(map(jax.device_put, weight)),
        tuple(map(jax.device_put, length)),
    )


def _take(values: np.ndarray, entry: np.ndarray) -> np.ndarray:
    # A mesh without edges has no entries.
    return values[entry] if len(values) else np.zeros(entry.shape, values.dtype)


def _limit_constraints(adjacency: sp.csr_matrix) -> sp.csr_matrix:
    """Limits the number of constraints per row; their weights keep their sum."""
    degree = np.diff(adjacency.indptr)
    if degree.max(initial=0) <= _MAX_CONSTRAINTS:
        return adjacency
    slot = np.arange(adjacency.nnz) - np.repeat(adjacency.indptr[:-1], degree)
    step = np.maximum(np.repeat(degree, degree) / _MAX_CONSTRAINTS, 1.0)
    # Keeps the first entry of each run of ``step``.
    keep = np.floor(slot / step) != np.floor((slot - 1) / step)
    limited = adjacency.copy()
    limited.data = np.where(keep, adjacency.data, 0.0)
    limited.eliminate_zeros()
    total, limited_sum = (np.asarray(m.sum(axis=1)).ravel() for m in (adjacency, limited))
    return sp.csr_matrix(sp.diags(total / np.maximum(limited_sum, 1e-12)) @ limited)


def _split_by_degree(degree: Int[np.ndarray, " rows"]) -> list[tuple[int, int]]:
    """Splits rows, sorted by number of constraints, so that they need the least padding."""
    count = len(degree)
    cuts = np.flatnonzero(np.diff(degree)) + 1
    if not len(cuts):
        return [(0, count)]
    filled = cuts * degree[cuts - 1] + (count - cuts) * degree[-1]
    cut = int(cuts[np.argmin(filled)])
    return [(0, cut), (cut, count)]


def limit_strain(
    constraints: EdgeConstraints, points: Float[Array, "rows 3"], steps: int
) -> Float[Array, "rows 3"]:
    """Moves points so that edges approach their rest lengths; pure, differentiable.

    Stretched regions contract, compressed regions fold. A few steps correct local strain
    and leave the overall position unchanged.

    Args:
        constraints: From `make_edge_constraints`.
        points: Positions [m].
        steps: Number of steps; with 0 nothing is computed.

    Returns:
        The points [m], equivariant to rigid motion.

    References:
        Macklin et al., Unified particle physics for real-time applications (2014), for
        averaged Jacobi projections; Müller and Chentanez, Wrinkle meshes (2010), for
        folds by projection of a few lengths.

    Example:
        >>> import numpy as np
        >>> square = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], np.float32)
        >>> springs = make_edge_constraints(square, np.array([[0, 1, 2], [2, 1, 3]]))
        >>> shrunk = limit_strain(springs, jnp.asarray(1.2 * square), 20)
        >>> bool(abs(jnp.linalg.norm(shrunk[1] - shrunk[0]) - 1) < 0.02)
        True
    """
    if steps == 0:
        return points
    # Far from the origin, differences between neighbours lose precision.
    origin = jax.lax.stop_gradient(points[:1])
    rows = (points - origin)[constraints.order]

    def step(carry: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], None]:
        last, before = carry
        ahead = last + _MOMENTUM * (last - before)
        groups = zip(
            constraints.starts,
            constraints.index,
            constraints.weight,
            constraints.length,
            strict=True,
        )
        return (jnp.concatenate([_jacobi_step(ahead, *group) for group in groups]), last), None

    # Gradients recompute the intermediates of a step instead of storing them.
    (rows, _), _ = jax.lax.scan(jax.checkpoint(step), (rows, rows), None, length=steps)
    return rows[constraints.back] + origin


def _jacobi_step(
    rows: Float[Array, "rows 3"],
    start: int,
    index: Int[Array, "k members"],
    weight: Float[Array, "k members"],
    length: Float[Array, "k members"],
) -> Float[Array, "members 3"]:
    mine = rows[start : start + index.shape[1]]

    def add_correction(out: Array, constraint: tuple[Array, Array, Array]) -> tuple[Array, None]:
        other, share, rest = constraint
        offsets = rows[other] - mine
        squared = jnp.sum(offsets * offsets, axis=1)
        # Padding has zero length; second derivatives must stay finite there too.
        min_squared = (_MIN_LENGTH_RATIO * rest) ** 2 + 1e-12
        pull = share * (1.0 - rest * jax.lax.rsqrt(jnp.maximum(squared, min_squared)))
        return out + pull[:, None] * offsets, None

    # A scan: unrolled, it takes three times as long to compile and runs no faster.
    return jax.lax.scan(add_correction, mine, (index, weight, length))[0]
