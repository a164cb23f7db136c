"""What a solver is: how a block of substeps moves the cloth."""

import abc
import dataclasses
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..errors import check_counts
from ._effect import Prepared
from ._state import System

if TYPE_CHECKING:
    from ._scene import PreparedScene

# A residual of 1: another sweep would move the worst vertex by this much [m].
TOLERANCE = 5e-4
# Frames a second that substeps and queries are stated for.
_RATE = 30.0


@dataclasses.dataclass(frozen=True)
class Solver(abc.ABC):
    """Settings that every solver has.

    Attributes:
        substeps: Steps a frame.
        queries: Blocks a frame: how often contact looks for the closest skin.
        precision: ``float32``, or ``float64`` for references.
    """

    substeps: int = 32
    queries: int = 4
    precision: str = "float32"

    def __post_init__(self) -> None:
        check_counts(self, "substeps", "queries")
        if self.substeps % self.queries:
            raise ValueError(
                f"substeps {self.substeps} must be a positive multiple of queries {self.queries}."
            )
        if self.precision not in ("float32", "float64"):
            raise ValueError(f"precision {self.precision!r} is neither float32 nor float64.")

    def at_rate(self, fps: float) -> "Solver":
        """These settings, meant for 30 frames a second, for motion of another rate.

        Blocks and substeps keep their length; a frame has at least one block.

        Args:
            fps: Frames a second of the motion.

        >>> from physxnet_jax.simulation import XPBD
        >>> XPBD(substeps=32, queries=4).at_rate(10.0).substeps
        96
        """
        each = self.substeps // self.queries
        queries = max(1, round(self.queries * _RATE / fps))
        return dataclasses.replace(self, substeps=each * queries, queries=queries)

    def prepare(self, scene: "PreparedScene") -> Any:
        """Tables the solver needs for a scene (a pytree), made once on the host."""
        return None

    def remember(self, velocity: Float[Array, "vertices 3 batch"], h: float) -> Any:
        """What `State.memory` holds at the start."""
        return ()

    @abc.abstractmethod
    def block(
        self,
        system: System,
        contexts: tuple[Any, ...],
        velocity: Float[Array, "vertices 3 batch"],
        memory: Any,
        h: float,
        count: int,
    ) -> tuple[Array, Array, Any]:
        """Moves the cloth through a block.

        Args:
            system: The scene.
            contexts: What the effects' `begin` returned.
            velocity: At the block's start [m/s].
            memory: As `remember` returned it, or the block before.
            h: Substep [s].
            count: Substeps of the block.

        Returns:
            Displacement over the block [m], velocity at its end, and the memory.
        """

    def residual(
        self,
        system: System,
        contexts: tuple[Any, ...],
        displacement: Float[Array, "vertices 3 batch"],
        memory: Any,
        h: float,
    ) -> Float[Array, "vertices batch"]:
        """How far each vertex is from where the constraints want it, over the tolerance."""
        moved = project_all(
            system.effects, contexts, displacement, displacement, jnp.ones(()), (h, 0.0)
        )
        gap = moved - displacement
        return jnp.sqrt(jnp.sum(gap * gap, axis=1)) / TOLERANCE


def project_all(
    effects: tuple[Prepared, ...],
    contexts: tuple[Any, ...],
    displacement: Array,
    start: Array,
    progress: Array,
    step: tuple[float, float],
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
    """Effects that store energy, and those that only constrain, with their contexts."""
    pairs = list(zip(effects, contexts, strict=True))
    return [p for p in pairs if p[0].elastic], [p for p in pairs if not p[0].elastic]


def stored_energy(elastic: list[tuple[Prepared, Any]], displacement: Array) -> Array:
    """Energy of all effects and batch members together [J]: its gradient is the force."""
    total = jnp.zeros((), displacement.dtype)
    for e, context in elastic:
        energy = e.energy(displacement, context)
        if energy is not None:
            total = total + jnp.sum(energy)
    return total
