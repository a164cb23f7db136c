"""The interface of solvers, which advance the cloth by one contact interval."""

import abc
import dataclasses
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..errors import check_counts
from ._effect import Prepared, Step
from ._prepared_scene import PreparedScene
from ._state import System

# At a residual of 1, another sweep would move the worst vertex by this much [m].
TOLERANCE = 5e-4
# Frames per second that `substeps` and `contact_updates` refer to.
_RATE = 30.0


@dataclasses.dataclass(frozen=True)
class Solver(abc.ABC):
    """Settings common to all solvers.

    Attributes:
        substeps: Steps per frame.
        contact_updates: Contact intervals per frame: number of searches for contacts.
        precision: ``float32``, or ``float64`` for references.
    """

    substeps: int = 32
    contact_updates: int = 4
    precision: str = "float32"

    def __post_init__(self) -> None:
        check_counts(self, "substeps", "contact_updates")
        if self.substeps % self.contact_updates:
            raise ValueError(
                f"substeps {self.substeps} must be a positive multiple of contact_updates"
                f" {self.contact_updates}."
            )
        if self.precision not in ("float32", "float64"):
            raise ValueError(f"precision {self.precision!r} is neither float32 nor float64.")

    def at_rate(self, fps: float) -> "Solver":
        """Converts these settings from 30 frames per second to another frame rate.

        Contact intervals and substeps keep their length, up to rounding; a frame has at
        least one contact interval.

        Args:
            fps: Frames per second of the motion.

        >>> from physxnet_jax.simulation import XPBD
        >>> XPBD(substeps=32, contact_updates=4).at_rate(10.0).substeps
        96
        """
        each = self.substeps // self.contact_updates
        contact_updates = max(1, round(self.contact_updates * _RATE / fps))
        return dataclasses.replace(
            self, substeps=each * contact_updates, contact_updates=contact_updates
        )

    def prepare(self, scene: PreparedScene) -> Any:
        """Tables that the solver needs for a scene (a pytree), built once on the host."""
        return None

    def init_state(self, velocity: Float[Array, "vertices 3 batch"], h: float) -> Any:
        """Initial value of `State.solver_state`."""
        return ()

    def at_step(self, system: System, h: float) -> System:
        """The scene with tables that depend on the length of a substep [s]."""
        return system

    @abc.abstractmethod
    def advance_interval(
        self,
        system: System,
        contexts: tuple[Any, ...],
        velocity: Float[Array, "vertices 3 batch"],
        solver_state: Any,
        h: float,
        count: int,
    ) -> tuple[Array, Array, Any]:
        """Advances the cloth by one contact interval.

        Args:
            system: The scene.
            contexts: Results of the effects' `begin`.
            velocity: Velocity at the start of the interval [m/s].
            solver_state: Result of `init_state` or of the previous interval.
            h: Length of a substep [s].
            count: Number of substeps.

        Returns:
            Displacement over the interval [m], velocity at its end, and the solver state.
        """

    def residual(
        self,
        system: System,
        contexts: tuple[Any, ...],
        displacement: Float[Array, "vertices 3 batch"],
        solver_state: Any,
        h: float,
    ) -> Float[Array, "vertices batch"]:
        """Distance that another sweep would move each vertex, over the tolerance."""
        moved = project_all(
            system.effects, contexts, displacement, displacement, jnp.ones(()), Step(h, 0.0)
        )
        correction = moved - displacement
        return jnp.sqrt(jnp.sum(correction * correction, axis=1)) / TOLERANCE


def project_all(
    effects: tuple[Prepared, ...],
    contexts: tuple[Any, ...],
    displacement: Array,
    start: Array,
    progress: Array,
    step: Step,
) -> Array:
    """One sweep over the constraints of all effects."""
    progress = progress.astype(displacement.dtype)
    for e, context in zip(effects, contexts, strict=True):
        displacement = e.project(displacement, start, context, progress, step)
    return displacement


def accelerate_all(
    effects: tuple[Prepared, ...], contexts: tuple[Any, ...], velocity: Array, h: float
) -> Array:
    """Velocities after all external forces have acted."""
    for e, context in zip(effects, contexts, strict=True):
        velocity = e.accelerate(velocity, context, h)
    return velocity


def split(
    effects: tuple[Prepared, ...], contexts: tuple[Any, ...]
) -> tuple[list[tuple[Prepared, Any]], list[tuple[Prepared, Any]]]:
    """Effects that store energy and effects that only constrain, with their contexts."""
    pairs = list(zip(effects, contexts, strict=True))
    return [p for p in pairs if p[0].elastic], [p for p in pairs if not p[0].elastic]


def stored_energy(elastic: list[tuple[Prepared, Any]], displacement: Array) -> Array:
    """Total energy of all effects and batch members [J]; its negative gradient is the force."""
    total = jnp.zeros((), displacement.dtype)
    for e, context in elastic:
        energy = e.energy(displacement, context)
        if energy is not None:
            total = total + jnp.sum(energy)
    return total
