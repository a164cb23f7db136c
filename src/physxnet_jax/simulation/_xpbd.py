"""XPBD with small steps: one coloured Gauss-Seidel sweep per substep."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..errors import SimulationError
from ._effect import Prepared, Step
from ._solver import Solver, accelerate_all
from ._state import System

# Share of BDF2 in a step of order 2; the rest is backward Euler. Sweeps of a fixed order exert
# small forces that aren't conservative. Pure BDF2 hardly damps the whirls that they feed.
_BDF2 = 0.8
# Weight of the substep before the last.
_BACK = _BDF2 / 3.0


@dataclasses.dataclass(frozen=True)
class XPBD(Solver):
    """The default solver: robust and cheap.

    Velocities come from the corrections of a substep, not from differences of
    positions, and positions are relative to the start of the contact interval. float32
    is therefore accurate for any length of substep and any distance from the origin.

    Order 2 is BDF2 blended with backward Euler. With the velocities ``v`` and displacements
    ``d`` of the last two substeps and ``b`` the weight of the earlier, a substep predicts
    ``v + b (v - v_before) + (1 - b) h a`` and ``d + b (d - d_before) + (1 - b) h v`` and
    projects with compliances over ``((1 - b) h)^2``. It costs nothing more than backward Euler,
    and loses far less of the motion to numerical damping.

    Attributes:
        order: 2, or 1 for backward Euler alone.

    References:
        Macklin et al., Small steps in physics simulation (2019), algorithm 1; English and
        Bridson, Animating developable surfaces using nonconforming elements (2008), section
        4, for BDF2 with constraints.
    """

    order: int = 2

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.order not in (1, 2):
            raise ValueError(f"order {self.order} is neither 1 nor 2.")

    def init_state(self, velocity: Array, h: float) -> Any:
        """What order 2 keeps of the last substep, and whether there was one.

        Displacement, the velocity before it, and 1 for vertices that contact pushed, else 0.
        """
        if self.order == 1:
            return ()
        return h * velocity, velocity, jnp.zeros_like(velocity[:, :1]), jnp.zeros((), bool)

    def _implicit_step(self, h: float) -> float:
        return h * (1.0 - _BACK) if self.order == 2 else h

    def at_step(self, system: System, h: float) -> System:
        step = self._implicit_step(h)
        effects = tuple(e.at_step(step) for e in system.effects)
        return dataclasses.replace(system, effects=effects)

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
        step = self._implicit_step(h)
        past: tuple[Array, ...] = ()
        if self.order == 2:
            last_move, last_v, touched, known = solver_state
            # External forces are taken to have acted before the first substep as well, so that
            # it is as accurate as the others.
            gain = accelerate_all(system.effects, contexts, velocity, h) - velocity
            last_v = jnp.where(known, last_v, velocity - gain)
            last_move = jnp.where(known, last_move, h * (velocity - _BACK / (1.0 - _BACK) * gain))
            past = last_move, last_v, touched

        def substep(i: Array, carry: tuple[Array, Array, Any]) -> tuple[Array, Array, Any]:
            d, v, before = carry
            ahead, start = v, d
            if before:
                last_move, last_v, _ = before
                ahead = v + _BACK * (v - last_v)
                start = d + _BACK * last_move
            ahead = accelerate_all(system.effects, contexts, ahead, step)
            predicted = start + step * ahead
            progress = (i + 1).astype(d.dtype) * share
            x, touched = predicted, jnp.zeros_like(d[:, :1])
            for e, context in zip(system.effects, contexts, strict=True):
                moved = e.project(x, d, context, progress, Step(step, share))
                if e.unilateral:
                    size = jnp.sum(jnp.abs(moved - x), axis=1, keepdims=True)
                    touched = jnp.maximum(touched, (size > 0).astype(d.dtype))
                x = moved
            new_v = ahead + (x - predicted) / step
            if not before:
                return x, new_v, ()
            # A push lasts for one substep, but the formula would spread it over the next ones
            # too, and throw off what touches: there, one step of backward Euler. By products,
            # since selections of rows aren't vectorised on CPUs and take three times as long.
            begins = touched * (1.0 - before[2])
            move = x - d
            new_v = new_v + begins * (move / h - new_v)
            return x, new_v, (move, v + begins * (new_v - v), touched)

        zero = jnp.zeros_like(velocity)
        d, v, past = jax.lax.fori_loop(0, count, substep, (zero, velocity, past))
        return d, v, (*past, jnp.ones((), bool)) if past else ()

    def residual(
        self,
        system: System,
        contexts: tuple[Any, ...],
        displacement: Array,
        solver_state: Any,
        h: float,
    ) -> Array:
        step = self._implicit_step(h)
        return super().residual(system, contexts, displacement, solver_state, step)
