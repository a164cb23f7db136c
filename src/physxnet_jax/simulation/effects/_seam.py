"""Seams: pairs of vertices sewn together."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ...errors import SimulationError, check_numbers
from ...typing import pytree
from .._assembly import Assembly
from .._effect import Effect, Prepared, Rest
from ._colored import Colored, Constraint, Group, color_constraints


@dataclasses.dataclass(frozen=True)
class Seam(Effect):
    """``E = 1/2 k |x_a - x_b|^2`` for each stitch; a large ``k`` pulls panels together.

    Attributes:
        stitches: Pairs of vertices of the scene, numbered over all garments in order.
        stiffness: Stiffness of one stitch [N/m].

    References:
        Baraff and Witkin, Large steps in cloth simulation (1998), for seams as springs.
    """

    stitches: tuple[tuple[int, int], ...] = ()
    stiffness: float = 1e4

    def __post_init__(self) -> None:
        check_numbers(self, "stiffness")
        wrong = [s for s in self.stitches if len(s) != 2]
        if wrong:
            raise ValueError(f"a stitch is a pair of vertices, not {wrong[0]}")

    def idle(self, assembly: Assembly) -> bool:
        """Without stitches."""
        return not self.stitches

    def prepare(self, assembly: Assembly, inverse_mass: Array) -> Prepared:
        """Colours the stitches so that a Gauss-Seidel sweep runs colour by colour."""
        pairs = np.asarray(self.stitches, np.int64).reshape(-1, 2)
        if pairs.size and not (0 <= pairs.min() and pairs.max() < len(assembly.rest)):
            wrong = int(pairs.min() if pairs.min() < 0 else pairs.max())
            raise SimulationError(
                f"A stitch names vertex {wrong}; the scene has {len(assembly.rest)} vertices,"
                " numbered from 0."
            )
        law = {"compliance": np.full(len(pairs), 1.0 / self.stiffness)}
        return _Seam(color_constraints(pairs, np.asarray(inverse_mass), law))


@pytree
@dataclasses.dataclass(frozen=True)
class _Seam(Colored):
    group: Group

    def reshaped(self, rest: Rest) -> Prepared:
        return dataclasses.replace(self, group=self.group.reshaped(rest, self.group.law))

    def measure(self, law: Any, corners: tuple[Array, ...]) -> list[Any]:
        def opening(x: tuple[Array, ...]) -> Constraint:
            span = x[1] - x[0]
            length = jnp.sqrt(jnp.sum(span * span, axis=1, keepdims=True) + 1e-18)
            n = span / length
            return Constraint(length, (-n, n), law["compliance"])

        return [opening]
