"""Bending: quadratic isometric energy over hinges, flat at rest."""

import dataclasses
import functools
import math
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ...typing import pytree
from .._assembly import Assembly
from .._effect import Clock, Effect, Prepared, Rest, Step
from ._colored import column, corner_pairs
from ._hinge import bending_hinges, hinge_stencils

# Largest amplitude that a step leaves of the roughest bending modes.
_DAMPED = 0.1
# Products with the stiffness matrix per substep, at most. They grow with the square root of the
# stiffness and with the length of a substep: a frame needs about as many at any setting.
_MOST = 32
# Stiffness for which a factor that isn't known when compiling leaves room.
_ROOM = 16.0
# Share of vertices whose hinges may be limited.
_LIMITED = 0.03
# Ordered pairs of different corners of a hinge.
_PAIRS = [(i, j) for i in range(4) for j in range(4) if i != j]


@dataclasses.dataclass(frozen=True)
class Bend(Effect):
    """``E = 1/2 sum k/(A_1 + A_2) |sum_i c_i x_i|^2`` over interior edges.

    The coefficients ``c`` come from cotangents of the rest shape, so the energy is
    quadratic and its Hessian K constant; see `bending_hinges` for its scale.
    Cloth is flat at rest, even where the garment is curved, as in a sleeve.

    XPBD applies a polynomial in ``h^2 W K`` (W: inverse masses), which agrees with the implicit
    step for smooth bending and damps rough bending. A polynomial that starts with K conserves
    linear and angular momentum exactly. Its degree is the smallest that is stable for the bulk
    of the mesh; the hinges of the few triangles that would need more, mostly slivers, are made
    softer for long substeps.

    References:
        Bergou, Wardetzky, Harmon, Zorin and Grinspun, A quadratic bending model for
        inextensible surfaces (2006), equation 5; Verwer, Sommeijer and Hundsdorfer, RKC
        time-stepping for advection-diffusion-reaction problems (2004), equations 2.5 to 2.8,
        for the polynomial.
    """

    def prepare(self, assembly: Assembly, inverse_mass: Array) -> Prepared:
        """Finds the neighbours that hinges couple."""
        h = bending_hinges(assembly)
        w = np.asarray(inverse_mass, np.float64)
        vertices = len(w)
        first = np.concatenate([h.corners[:, i] for i, _ in _PAIRS]).astype(np.int64)
        second = np.concatenate([h.corners[:, j] for _, j in _PAIRS]).astype(np.int64)
        keys, entry = np.unique(first * vertices + second, return_inverse=True)
        rows, slot = _sparse_rows(keys // vertices, keys % vertices, vertices)
        index = h.corners.astype(np.int32)
        hinges = _Hinges(
            tuple(jax.device_put(index[:, i]) for i in range(4)),
            tuple(column(h.coefficient[:, i]) for i in range(4)),
            column(1.0 / np.maximum(h.stiffness, 1e-12)),
            column(h.stiffness * h.area),
        )
        load = _load(w, h.corners, h.coefficient, h.stiffness)
        # A power of two, so that body shapes share a compiled program.
        typical = max(float(np.quantile(load, 1.0 - _LIMITED)), 1e-12) if len(load) else 1e-12
        return _Bend(
            hinges,
            jax.device_put(w.astype(np.float32)),
            rows,
            jax.device_put(slot[entry].reshape(len(_PAIRS), -1).astype(np.int32)),
            2.0 ** math.ceil(math.log2(typical)),
        )


def _load(
    w: Float[np.ndarray, " vertices"],
    corners: Int[np.ndarray, "hinges 4"],
    coefficient: Float[np.ndarray, "hinges 4"],
    stiffness: Float[np.ndarray, " hinges"],
) -> Float[np.ndarray, " vertices"]:
    """Row sums that bound the eigenvalues of W K [1/s^2]."""
    size = np.abs(coefficient)
    share = stiffness[:, None] * size * size.sum(axis=1, keepdims=True)
    out = np.zeros(len(w))
    np.add.at(out, corners, w[corners] * share)
    return out


@pytree
@dataclasses.dataclass(frozen=True)
class _Rows:
    """Neighbours of each vertex: a table for all vertices, and one more for a few with many.

    Attributes:
        near: Neighbours; a vertex with fewer repeats itself.
        many: Vertices with more neighbours than that.
        more: Their further neighbours.
    """

    near: Int[Array, "width vertices"]
    many: Int[Array, " many"]
    more: Int[Array, "further many"]

    def product(self, values: Float[Array, " slots"], x: Array) -> Array:
        """For each vertex i the sum of ``values[i, j] (x_i - x_j)``."""
        near = values[: self.near.size].reshape(self.near.shape)
        # A reduction, not a sum of terms: XLA would compute those anew for every use.
        out = jnp.sum(near[..., None, None] * (x[None] - x[self.near]), axis=0)
        if self.many.size:
            more = values[self.near.size :].reshape(self.more.shape)
            gap = x[self.many][None] - x[self.more]
            out = out.at[self.many].add(
                jnp.sum(more[..., None, None] * gap, axis=0), unique_indices=True
            )
        return out


def _sparse_rows(
    row: Int[np.ndarray, " entries"], neighbor: Int[np.ndarray, " entries"], vertices: int
) -> tuple[_Rows, Int[np.ndarray, " entries"]]:
    """Tables of sorted entries of a sparse matrix, and the slot of each entry in them."""
    begin = np.searchsorted(row, np.arange(vertices + 1))
    count = np.diff(begin)
    most = int(count.max(initial=0))
    # A gather and a scatter of the vertices with many cost about four more entries.
    cost = [
        n * vertices + (most - n + 4) * int((count > n).sum()) * (n < most) for n in range(most + 1)
    ]
    width = int(np.argmin(cost))
    rank = np.arange(len(row)) - begin[row]
    many = np.flatnonzero(count > width)
    at = np.zeros(vertices, np.int64)
    at[many] = np.arange(len(many))
    near = np.repeat(np.arange(vertices)[None], width, axis=0)
    more = np.repeat(many[None], most - width, axis=0)
    first = rank < width
    near[rank[first], row[first]] = neighbor[first]
    more[rank[~first] - width, at[row[~first]]] = neighbor[~first]
    slot = np.where(first, rank * vertices + row, near.size + (rank - width) * len(many) + at[row])
    tables = (jax.device_put(t.astype(np.int32)) for t in (near, many, more))
    return _Rows(*tables), slot


def _chebyshev(degree: int) -> tuple[list[tuple[float, float]], float]:
    """Coefficients of each stage, and the largest eigenvalue for which they are stable.

    The polynomial is ``T_n(a + b z) / T_n(a)`` with ``T_n(a) = 1 / _DAMPED`` and slope 1 at 0.
    """
    angle = math.acosh(1.0 / _DAMPED) / degree
    a = math.cosh(angle)
    b = math.sinh(angle) / (degree * math.sinh(degree * angle) * _DAMPED)
    scale = [1.0 / math.cosh(k * angle) for k in range(degree + 1)]
    stages = [(1.0, b / a)]
    for k in range(2, degree + 1):
        ratio = 2.0 * scale[k] / scale[k - 1]
        stages.append((ratio * a, ratio * b))
    return stages, (a + 1.0) / b


def _degree(eigenvalue: float) -> int:
    """Fewest stages that are stable for an eigenvalue, at most `_MOST`."""
    return next((n for n in range(1, _MOST) if _chebyshev(n)[1] >= eigenvalue), _MOST)


@pytree
@dataclasses.dataclass(frozen=True)
class _Hinges:
    index: tuple[Int[Array, " members"], ...]
    coefficient: tuple[Float[Array, "members 1 1"], ...]
    compliance: Float[Array, "members 1 1"]
    modulus: Float[Array, "members 1 1"]


@pytree
@dataclasses.dataclass(frozen=True)
class _Bend(Prepared):
    """Prepared bending.

    Attributes:
        hinges: Corners, coefficients, compliances [m/N] and bending stiffness of the fabric [N m].
        weight: Inverse masses [1/kg].
        rows: Vertices coupled to each vertex.
        slots: Where each of `_PAIRS` of a hinge adds to ``values``.
        typical: Bound of the eigenvalues of W K for all but a few vertices [1/s^2].
        values: Entries of -W K for one length of substep [1/s^2]; None before `at_step`.
    """

    elastic = True
    materials = ("bend",)
    hinges: _Hinges
    weight: Float[Array, " vertices"]
    rows: _Rows
    slots: Int[Array, "12 members"]
    typical: float = dataclasses.field(metadata={"static": True})
    values: Float[Array, " slots"] | None = None

    def rescaled(self, factors: Mapping[str, Any]) -> Prepared:
        if "bend" not in factors:
            return self
        h, factor = self.hinges, factors["bend"]
        softer = dataclasses.replace(
            h, compliance=h.compliance / factor, modulus=h.modulus * factor
        )
        known = factor if isinstance(factor, (int, float)) else _ROOM
        typical = 2.0 ** math.ceil(math.log2(self.typical * known))
        return dataclasses.replace(self, hinges=softer, typical=typical)

    def reshaped(self, rest: Rest) -> Prepared:
        h = self.hinges
        coefficient, area = hinge_stencils(*(rest.cloth[i] for i in h.index), xp=jnp)
        hinges = dataclasses.replace(
            h,
            coefficient=tuple(c[:, None, None] for c in coefficient),
            compliance=1.0 / jnp.maximum(h.modulus / area[:, None, None], 1e-12),
        )
        return dataclasses.replace(self, hinges=hinges, weight=rest.inverse_mass, values=None)

    def at_step(self, h: float) -> Prepared:
        """Assembles W K."""
        return dataclasses.replace(self, values=_assembled(self, h))

    def begin(self, base: Array, start: None, end: None, clock: Clock, state: Any) -> tuple:
        return base, () if self.values is None else self.rows.product(self.values, base)

    def project(
        self,
        displacement: Array,
        start: Array,
        context: tuple,
        progress: Array,
        step: Step,
    ) -> Array:
        assert self.values is not None
        h2 = step.length * step.length
        before, moved = jnp.zeros_like(displacement), jnp.zeros_like(displacement)
        for old, new in _chebyshev(_degree(self.typical * h2))[0]:
            push = h2 * (context[1] + self.rows.product(self.values, displacement + moved))
            moved, before = old * moved + (1.0 - old) * before + new * push, moved
        return displacement + moved

    def energy(self, displacement: Array, context: tuple) -> Array:
        h, base = self.hinges, context[0]
        first = base[h.index[0]]
        curvature = jnp.zeros_like(first)
        for c, i in zip(h.coefficient, h.index, strict=True):
            # The coefficients sum to 0.
            curvature = curvature + c * ((base[i] - first) + displacement[i])
        return 0.5 * jnp.sum(curvature**2 / h.compliance, axis=(0, 1))

    def coupled(self) -> Int[np.ndarray, "blocks 2"]:
        return corner_pairs(self.hinges.index)

    def constant_stiffness(self) -> Float[Array, " blocks"]:
        h = self.hinges
        c = [x[:, 0, 0] for x in h.coefficient]
        k = 1.0 / h.compliance[:, 0, 0]
        return jnp.concatenate([k * a * b for a in c for b in c])


@functools.partial(jax.jit, static_argnums=1)
def _assembled(bend: _Bend, h: float) -> Float[Array, " slots"]:
    """The values of W K, with hinges softened where it would be unstable."""
    hinges, rows = bend.hinges, bend.rows
    corners = hinges.index
    c = [x[:, 0, 0] for x in hinges.coefficient]
    k = 1.0 / hinges.compliance[:, 0, 0]
    size = [jnp.abs(x) for x in c]
    total = sum(size)
    load = jnp.zeros_like(bend.weight)
    for i, s in zip(corners, size, strict=True):
        load = load.at[i].add(bend.weight[i] * k * s * total)
    bound = _chebyshev(_degree(bend.typical * h * h))[1] / (h * h)
    soft = jnp.minimum(1.0, bound / jnp.maximum(load, 1e-12))
    k = k * jnp.minimum(
        jnp.minimum(soft[corners[0]], soft[corners[1]]),
        jnp.minimum(soft[corners[2]], soft[corners[3]]),
    )
    added = jnp.stack([k * c[i] * c[j] for i, j in _PAIRS])
    values = jnp.zeros(rows.near.size + rows.more.size, k.dtype).at[bend.slots].add(added)
    everyone = jnp.arange(len(bend.weight), dtype=rows.many.dtype)
    owner = jnp.concatenate(
        [
            jnp.broadcast_to(v, t.shape).ravel()
            for v, t in ((everyone, rows.near), (rows.many, rows.more))
        ]
    )
    return values * bend.weight[owner]
