"""Dihedral bending: the angle between triangles, for large rotations and folds."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ...typing import pytree
from .._assembly import Assembly
from .._effect import Effect, Prepared
from ._colored import Colored, Constraint, Group, color_constraints
from ._hinge import bending_hinges


@dataclasses.dataclass(frozen=True)
class Dihedral(Effect):
    """``E = 1/2 sum k |e|^2 / (A_1 + A_2) theta^2`` over interior edges.

    ``theta`` is the signed angle between the normals, zero at rest. Unlike `Bend` it
    stays correct when the cloth stretches or folds back; see `bending_hinges` for its
    scale.

    References:
        Grinspun et al., Discrete shells (2003), equation 2 with the flat rest angle;
        gradients after Bridson, Marino and Fedkiw (2003), section 4.
    """

    def prepare(self, assembly: Assembly, inverse_mass: Array) -> Prepared:
        """Colours the hinges so that a Gauss-Seidel sweep runs colour by colour."""
        h = bending_hinges(assembly)
        law = {"compliance": 1.0 / np.maximum(h.stiffness * h.length**2, 1e-12)}
        return _Dihedral(color_constraints(h.corners, np.asarray(inverse_mass), law))


@pytree
@dataclasses.dataclass(frozen=True)
class _Dihedral(Colored):
    group: Group

    materials = ("bend",)

    def rescaled(self, factors: Mapping[str, Any]) -> Prepared:
        if "bend" not in factors:
            return self
        law = {"compliance": self.group.law["compliance"] / factors["bend"]}
        return dataclasses.replace(self, group=dataclasses.replace(self.group, law=law))

    def measure(self, law: Any, corners: tuple[Array, ...]) -> list[Any]:
        def angle(x: tuple[Array, ...]) -> Constraint:
            # Edge a-b with the opposite corners p (left) and q (right).
            a, b, p, q = x
            e = b - a
            length = _norm(e)
            left, right = jnp.cross(e, p - a, axis=1), jnp.cross(q - a, e, axis=1)
            # A triangle without area has no normal: it is treated as a sliver.
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
