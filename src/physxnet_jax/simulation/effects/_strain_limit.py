"""Strain limiting: an upper bound on the elongation of edges."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ...errors import check_numbers
from ...geometry import mesh_edges
from ...typing import pytree
from .._assembly import Assembly
from .._effect import Effect, Prepared
from ._colored import Colored, Constraint, Group, color_constraints


@dataclasses.dataclass(frozen=True)
class StrainLimit(Effect):
    """Bounds the elongation of edges: woven cloth stiffens once its threads are straight.

    Runs one sweep per substep and stores no energy.

    Attributes:
        limit: Maximum elongation relative to the rest length [1].

    References:
        Provot, Deformation constraints in a mass-spring model (1995).
    """

    limit: float = 0.1

    def __post_init__(self) -> None:
        check_numbers(self, "limit", zero=True)

    def prepare(self, assembly: Assembly, inverse_mass: Array) -> Prepared:
        """Colours the edges."""
        x = assembly.rest
        ends = mesh_edges(assembly.faces).vertices
        length = np.linalg.norm(x[ends[:, 0]] - x[ends[:, 1]], axis=1)
        law = {"longest": (1 + self.limit) * np.maximum(length, 1e-4)}
        return _StrainLimit(color_constraints(ends, np.asarray(inverse_mass), law))


@pytree
@dataclasses.dataclass(frozen=True)
class _StrainLimit(Colored):
    elastic = False
    group: Group

    def measure(self, law: Any, corners: tuple[Array, ...]) -> list[Any]:
        def excess(x: tuple[Array, ...]) -> Constraint:
            length = jnp.sqrt(jnp.sum(x[1] * x[1], axis=1, keepdims=True) + 1e-18)
            n = x[1] / length
            over = jnp.maximum(length - law["longest"], 0.0)
            return Constraint(over, (-n, n), jnp.zeros_like(law["longest"]))

        return [excess]

    def energy(self, displacement: Array, context: tuple) -> None:
        return None
