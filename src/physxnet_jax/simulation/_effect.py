"""The interface of effects: the forces and constraints that a scene lists."""

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

import numpy as np
from jaxtyping import Array, Float, Int

from ..errors import SimulationError
from ..typing import pytree
from ._assembly import Assembly


@pytree
@dataclasses.dataclass(frozen=True)
class SkinnedPoints:
    """Points to be skinned with the body for an effect, at rest.

    Attributes:
        rest: Rest positions [m], shape [points, 3].
        normals: Rest unit normals, shape [points, 3].
        weights: Skinning weights, shape [points, joints].
    """

    rest: Float[Array, "points 3"]
    normals: Float[Array, "points 3"]
    weights: Float[Array, "points joints"]


@pytree
@dataclasses.dataclass(frozen=True)
class PosedPoints:
    """Skinned points at one time.

    Attributes:
        points: Positions [m], shape [points, 3, batch].
        normals: Normals of almost unit length, shape [points, 3, batch].
    """

    points: Float[Array, "points 3 batch"]
    normals: Float[Array, "points 3 batch"]


@pytree
@dataclasses.dataclass(frozen=True)
class Clock:
    """Start and length of a contact interval.

    Attributes:
        time: Start of the interval, relative to the clip's first frame [s].
        length: Length of the interval [s].
    """

    time: Float[Array, ""]
    length: float = dataclasses.field(metadata={"static": True})


class Step(NamedTuple):
    """A substep.

    Attributes:
        length: Length for implicit formulas [s]; for BDF2 two thirds of the substep.
        share: The substep's fraction of the contact interval.
    """

    length: float
    share: float


class Rest(NamedTuple):
    """The rest state of a scene, see `System.reshaped`.

    Attributes:
        cloth: Vertices of all garments [m].
        body: Vertices of the body [m].
        normals: Unit normals of the skin's vertices.
        inverse_mass: Inverse masses of the cloth's vertices [1/kg].
    """

    cloth: Float[Array, "vertices 3"]
    body: Float[Array, "all 3"]
    normals: Float[Array, "skin 3"]
    inverse_mass: Float[Array, " vertices"]


class Prepared:
    """An effect prepared for a scene: a pytree whose hooks do nothing by default.

    A contact interval is a part of a frame during which the results of contact searches
    are reused. ``base`` holds the cloth positions at its start; ``displacement`` is
    relative to them, which keeps float32 accurate far from the origin. The batch is the
    last axis everywhere: gathers move whole rows, element-wise work is contiguous.
    """

    # Whether the effect stores energy; every solver projects those that don't.
    elastic: ClassVar[bool] = False
    # Whether the effect prescribes vertex positions.
    kinematic: ClassVar[bool] = False
    # Whether the effect only pushes, as contact does; XPBD starts anew where it begins to.
    unilateral: ClassVar[bool] = False
    # Factors of `System.rescaled` that apply to the effect.
    materials: ClassVar[tuple[str, ...]] = ()

    @property
    def skinned_points(self) -> SkinnedPoints | None:
        """Points to be skinned for this effect, or None."""
        return None

    def rescaled(self, factors: Mapping[str, Any]) -> "Prepared":
        """The effect with scaled material parameters, see `System.rescaled`."""
        return self

    def reshaped(self, rest: Rest) -> "Prepared":
        """The effect for another rest state, see `System.reshaped`.

        Raises:
            SimulationError: The effect's tables can't be changed.
        """
        raise SimulationError(
            f"The effect {type(self).__name__.lstrip('_')} can't be reshaped; prepare the scene"
            " anew."
        )

    def at_step(self, h: float) -> "Prepared":
        """The effect with tables for implicit substeps of ``h`` [s], for `project`."""
        return self

    def init_state(self, batch: int) -> Any:
        """Effect state before the first contact interval (a pytree)."""
        return ()

    def update_state(self, context: Any) -> Any:
        """Effect state for the next contact interval, with the same structure."""
        return ()

    def receive(self, state: Any, guide: tuple[Array, Array], begins: Array, length: float) -> Any:
        """Effect state for a frame in which the cloth is drawn from one place to another.

        Args:
            state: The effect's state.
            guide: Means [m] at the start and at the end of the frame.
            begins: Start of the frame [s].
            length: Length of the frame [s].
        """
        return state

    def begin(
        self,
        base: Float[Array, "vertices 3 batch"],
        start: Any,
        end: Any,
        clock: Clock,
        state: Any,
    ) -> Any:
        """Context of a contact interval for the other hooks (a pytree, or None).

        Args:
            base: Cloth positions at the start of the interval [m].
            start: Skinned points at the start of the interval, a `PosedPoints` or None.
            end: Skinned points at its end.
            clock: Start and length of the interval.
            state: Result of `update_state` for the previous interval.
        """
        return None

    def accelerate(
        self, velocity: Float[Array, "vertices 3 batch"], context: Any, h: float
    ) -> Float[Array, "vertices 3 batch"]:
        """Velocities [m/s] after external forces have acted for a time ``h`` [s]."""
        return velocity

    def energy(
        self, displacement: Float[Array, "vertices 3 batch"], context: Any
    ) -> Float[Array, " batch"] | None:
        """Stored energy [J], differentiable; None for effects that store none."""
        return None

    def coupled(self) -> Int[np.ndarray, "blocks 2"]:
        """Pairs of vertices that the Hessian of the energy couples."""
        return np.zeros((0, 2), np.int64)

    def hessian(
        self, displacement: Float[Array, "vertices 3 batch"], context: Any
    ) -> Float[Array, "blocks batch 3 3"] | None:
        """Blocks of the Hessian [N/m], made positive semidefinite, in the order of `coupled`."""
        return None

    def constant_stiffness(self) -> Float[Array, " blocks"] | None:
        """Factors of blocks that are constant multiples of the identity [N/m], likewise."""
        return None

    def project(
        self,
        displacement: Float[Array, "vertices 3 batch"],
        start: Float[Array, "vertices 3 batch"],
        context: Any,
        progress: Float[Array, ""],
        step: Step,
    ) -> Float[Array, "vertices 3 batch"]:
        """Displacements [m] after projection onto the effect's constraints.

        Args:
            displacement: Displacement since the start of the contact interval [m].
            start: Displacement at the start of this substep [m].
            context: Result of `begin`.
            progress: Fraction of the interval done at the end of this substep, 0 to 1.
            step: The substep.
        """
        return displacement

    def diagnose(
        self, displacement: Float[Array, "vertices 3 batch"], context: Any
    ) -> dict[str, Float[Array, " batch"]]:
        """Named scalars at the end of a frame, see `Rollout`."""
        return {}


@dataclasses.dataclass(frozen=True)
class Effect:
    """Settings of an effect; `prepare` applies them to a scene."""

    def prepare(self, assembly: Assembly, inverse_mass: Array) -> Prepared:
        """The prepared effect for these garments on this body."""
        raise TypeError(f"{type(self).__name__} does not implement prepare().")

    def idle(self, assembly: Assembly) -> bool:
        """Whether it does nothing to these garments, so that it is left out of the program."""
        return False
