"""XPBD with small steps: one coloured Gauss-Seidel sweep per substep."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..errors import SimulationError
from ._effect import Prepared
from ._solver import Solver, accelerate_all, project_all
from ._state import System


@dataclasses.dataclass(frozen=True)
class XPBD(Solver):
    """The default solver: robust, cheap, first order in the number of substeps.

    Velocities come from the corrections of a substep, not from differences of
    positions, and positions are relative to the start of the contact interval. float32
    is therefore accurate for any length of substep and any distance from the origin.

    References:
        Macklin et al., Small steps in physics simulation (2019), algorithm 1.
    """

    def advance_interval(
        self,
        system: System,
        contexts: tuple[Any, ...],
        velocity: Array,
        solver_state: Any,
        h: float,
        count: int,
    ) -> tuple[Array, Array, Any]:
        for e in system.effects:
            if e.elastic and type(e).project is Prepared.project:
                raise SimulationError(
                    f"{type(e).__name__} stores energy but does not implement `project`, which"
                    " XPBD requires. Implement it, or choose Verlet or Implicit."
                )
        share = 1.0 / count

        def substep(i: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
            d, v = carry
            v = accelerate_all(system.effects, contexts, v, h)
            predicted = d + h * v
            progress = (i + 1).astype(d.dtype) * share
            x = project_all(system.effects, contexts, predicted, d, progress, (h, share))
            return x, v + (x - predicted) / h

        d, v = jax.lax.fori_loop(0, count, substep, (jnp.zeros_like(velocity), velocity))
        return d, v, solver_state
