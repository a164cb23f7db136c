"""What an effect is: an entry of a scene that leaves no trace when absent."""

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Array, Float, Int

from ..typing import pytree
from ._assembly import Assembly


@pytree
@dataclasses.dataclass(frozen=True)
class Attached:
    """Points that an effect needs skinned with the body.

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
class Placed:
    """Attached points at one moment.

    Attributes:
        points: Positions [m], shape [points, 3, batch].
        normals: Normals, nearly unit, shape [points, 3, batch].
    """

    points: Float[Array, "points 3 batch"]
    normals: Float[Array, "points 3 batch"]


@pytree
@dataclasses.dataclass(frozen=True)
class Clock:
    """When a block takes place.

    Attributes:
        time: Since the clip's first frame, at the block's start [s].
        length: Of the block [s].
    """

    time: Float[Array, ""]
    length: float = dataclasses.field(metadata={"static": True})


class Prepared:
    """An effect made ready for a scene: a pytree with hooks that default to nothing.

    A block is a stretch of time within a frame over which queries are kept. Its
    ``base`` are the cloth's positions at its start; ``displacement`` is relative to
    them, which keeps float32 exact far from the origin. The batch of actions is the
    minor axis everywhere: gathers move whole rows, element-wise work is contiguous.
    """

    # Whether it stores energy; what doesn't is projected by every solver.
    elastic: ClassVar[bool] = False
    # Whether it prescribes where vertices are.
    holds: ClassVar[bool] = False
    # Which factors of `System.rescaled` it knows.
    materials: ClassVar[tuple[str, ...]] = ()

    @property
    def attached(self) -> Attached | None:
        """Points to be skinned for this effect, if it needs any."""
        return None

    def rescaled(self, factors: Mapping[str, Any]) -> "Prepared":
        """The effect with material parameters multiplied, see `System.rescaled`."""
        return self

    def initial(self, batch: int) -> Any:
        """What the effect remembers before the first block (a pytree)."""
        return ()

    def keep(self, context: Any) -> Any:
        """What it remembers for the next block, of the same structure."""
        return ()

    def begin(
        self,
        base: Float[Array, "vertices 3 batch"],
        start: Any,
        end: Any,
        clock: Clock,
        memory: Any,
    ) -> Any:
        """What the other hooks need for a block (a pytree; None for nothing).

        Args:
            base: Cloth positions at the block's start [m].
            start: The attached points at the block's start, a `Placed` or None.
            end: The same at its end.
            clock: Time at the block's start.
            memory: What `keep` returned for the block before.
        """
        return None

    def accelerate(
        self, velocity: Float[Array, "vertices 3 batch"], context: Any, h: float
    ) -> Float[Array, "vertices 3 batch"]:
        """Velocities [m/s] after external forces have acted for ``h`` [s]."""
        return velocity

    def energy(
        self, displacement: Float[Array, "vertices 3 batch"], context: Any
    ) -> Float[Array, " batch"] | None:
        """Stored energy [J], differentiable; None for effects that store none."""
        return None

    def coupled(self) -> Int[np.ndarray, "blocks 2"]:
        """Pairs of vertices that the energy's second derivative couples."""
        return np.zeros((0, 2), np.int64)

    def hessian(
        self, displacement: Float[Array, "vertices 3 batch"], context: Any
    ) -> Float[Array, "blocks batch 3 3"] | None:
        """Its blocks [N/m], made positive semidefinite, in the order of `coupled`."""
        return None

    def constant_stiffness(self) -> Float[Array, " blocks"] | None:
        """Blocks that are constant multiples of the identity [N/m], likewise."""
        return None

    def project(
        self,
        displacement: Float[Array, "vertices 3 batch"],
        start: Float[Array, "vertices 3 batch"],
        context: Any,
        progress: Float[Array, ""],
        step: tuple[float, float],
    ) -> Float[Array, "vertices 3 batch"]:
        """Displacements [m] after the effect's constraints.

        Args:
            displacement: Since the block's start [m].
            start: Displacement at the start of this substep [m].
            context: What `begin` returned.
            progress: Share of the block done at the end of this substep, 0 to 1.
            step: The substep [s] and its share of the block.
        """
        return displacement

    def diagnose(
        self, displacement: Float[Array, "vertices 3 batch"], context: Any
    ) -> dict[str, Float[Array, " batch"]]:
        """Scalars at a frame's end, by name: see `Diagnostics`."""
        return {}


@dataclasses.dataclass(frozen=True)
class Effect:
    """Settings of an effect; `prepare` makes it ready for a scene."""

    def prepare(self, assembly: Assembly, inverse_mass: Array) -> Prepared:
        """The effect for these garments on this body."""
        raise TypeError(f"{type(self).__name__} doesn't say how it is prepared.")
