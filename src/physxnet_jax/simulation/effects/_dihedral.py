"""Dihedral bending: the angle between triangles, for large rotations and folds."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ...geometry import hinges
from ...typing import pytree
from .._assembly import Assembly
from .._effect import Effect, Prepared
from ._coloured import Coloured, Constraint, Group, colour_groups


@dataclasses.dataclass(frozen=True)
class Dihedral(Effect):
    """``E = 1/2 sum c k |e|^2 / (A_1 + A_2) theta^2`` over interior edges.

    ``theta`` is the signed angle between the normals, flat at rest. Unlike `Bend` it
    stays right when the cloth stretches or folds back. What hinges make of a curvature
    depends on how the mesh is cut (`Bend` says how much); ``c`` is chosen once a mesh
    so that cylinders store the right energy on average over their directions.

    References:
        Grinspun et al., Discrete shells (2003), equation 2 with the flat rest angle;
        gradients after Bridson, Marino and Fedkiw (2003), section 4.
    """

    def prepare(self, assembly: Assembly, inverse_mass: Array) -> Prepared:
        """Colours the hinges so that a Gauss-Seidel sweep runs group by group."""
        quads = hinges(assembly.faces)
        _, area = hinge_stencils(assembly.rest, quads)
        x = assembly.rest
        length = np.linalg.norm(x[quads[:, 1]] - x[quads[:, 0]], axis=1)
        usable = (area > 1e-10) & (length > 1e-6)
        quads, area, length = quads[usable], area[usable], length[usable]
        k = hinge_stiffness(assembly, quads) * length**2 / area
        k *= _calibration(x, quads, area, length)
        law = {"compliance": 1.0 / np.maximum(k, 1e-12)}
        return _Dihedral(colour_groups(quads, np.asarray(inverse_mass), law))


def hinge_stencils(
    x: Float[np.ndarray, "vertices 3"], quads: Int[np.ndarray, "hinges 4"]
) -> tuple[Float[np.ndarray, "hinges 4"], Float[np.ndarray, " hinges"]]:
    """Coefficients of (a, b, left, right) and the area of both triangles."""
    a, b, p, q = (x[quads[:, i]] for i in range(4))

    def cot(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        sine = np.linalg.norm(np.cross(u, v), axis=1)
        return np.einsum("ij,ij->i", u, v) / np.maximum(sine, 1e-9)

    at_a = cot(b - a, p - a), cot(b - a, q - a)
    at_b = cot(a - b, p - b), cot(a - b, q - b)
    c = np.column_stack(
        [at_b[0] + at_b[1], at_a[0] + at_a[1], -at_a[0] - at_b[0], -at_a[1] - at_b[1]]
    )
    area = 0.5 * (
        np.linalg.norm(np.cross(b - a, p - a), axis=1)
        + np.linalg.norm(np.cross(b - a, q - a), axis=1)
    )
    return c, area


def hinge_stiffness(
    assembly: Assembly, quads: Int[np.ndarray, "hinges 4"]
) -> Float[np.ndarray, " hinges"]:
    """Bending stiffness [N m] of each hinge, its garment's."""
    of_vertex = np.zeros(len(assembly.rest))
    of_vertex[assembly.faces] = assembly.bend[:, None]
    return of_vertex[quads[:, 0]]


def _calibration(
    x: Float[np.ndarray, "vertices 3"],
    quads: Int[np.ndarray, "hinges 4"],
    area: Float[np.ndarray, " hinges"],
    length: Float[np.ndarray, " hinges"],
) -> float:
    """What brings the energy of cylinders, over all directions, to ``A kappa^2 / 2``."""
    a, b, p, q = (x[quads[:, i]] for i in range(4))
    along = (b - a) / length[:, None]
    # Both triangles unfolded into the plane: the edge on the first axis.
    flat = np.zeros((len(quads), 4, 2))
    flat[:, 1, 0] = length
    for k, (corner, side) in enumerate(((p, 1.0), (q, -1.0)), start=2):
        u = np.einsum("ij,ij->i", corner - a, along)
        flat[:, k, 0] = u
        flat[:, k, 1] = side * np.linalg.norm(corner - a - u[:, None] * along, axis=1)
    lifted = np.concatenate([flat, np.zeros((*flat.shape[:2], 1))], axis=2)
    c, _ = hinge_stencils(lifted.reshape(-1, 3), np.arange(4 * len(quads)).reshape(-1, 4))
    measured = 0.0
    for angle in np.arange(8) * np.pi / 8:
        height = 0.5 * (flat @ [np.cos(angle), np.sin(angle)]) ** 2
        measured += float(np.sum(np.einsum("hk,hk->h", c, height) ** 2 / area)) / 8
    return float(area.sum() / 3) / max(measured, 1e-12)


@pytree
@dataclasses.dataclass(frozen=True)
class _Dihedral(Coloured):
    groups: tuple[Group, ...]

    def measure(self, law: Any, corners: tuple[Array, ...]) -> list[Any]:
        def angle(x: tuple[Array, ...]) -> Constraint:
            # Edge a-b with the opposite corners p (left) and q (right).
            a, b, p, q = x
            e = b - a
            length = _norm(e)
            left, right = jnp.cross(e, p - a, axis=1), jnp.cross(q - a, e, axis=1)
            # A triangle without area has no normal: it counts as a sliver.
            sl = jnp.maximum(jnp.sum(left * left, axis=1, keepdims=True), 1e-16)
            sr = jnp.maximum(jnp.sum(right * right, axis=1, keepdims=True), 1e-16)
            n, m = left / jnp.sqrt(sl), right / jnp.sqrt(sr)
            unit = e / length
            sine = jnp.sum(jnp.cross(n, m, axis=1) * unit, axis=1, keepdims=True)
            cosine = jnp.sum(n * m, axis=1, keepdims=True)
            theta = jnp.arctan2(sine, jnp.where((sine == 0) & (cosine == 0), 1.0, cosine))
            by_p, by_q = -length / sl * left, -length / sr * right

            def share(end: Array, corner: Array) -> Array:
                return jnp.sum((corner - end) * e, axis=1, keepdims=True) / (length * length)

            by_a = -(1 - share(a, p)) * by_p - (1 - share(a, q)) * by_q
            by_b = -share(a, p) * by_p - share(a, q) * by_q
            return Constraint(theta, (by_a, by_b, by_p, by_q), law["compliance"])

        return [angle]


def _norm(x: Array) -> Array:
    return jnp.sqrt(jnp.sum(x * x, axis=1, keepdims=True) + 1e-18)
