"""What an effect is: an entry of a scene that leaves no trace when absent."""

import dataclasses
from typing import Any

from jaxtyping import Array, Float

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


class Prepared:
    """An effect made ready for a scene: a pytree with hooks that default to nothing.

    A block is a stretch of time within a frame over which queries are kept. Its
    ``base`` are the cloth's positions at its start; ``displacement`` is relative to
    them, which keeps float32 exact far from the origin. The batch of actions is the
    minor axis everywhere: gathers move whole rows, element-wise work is contiguous.
    """

    @property
    def attached(self) -> Attached | None:
        """Points to be skinned for this effect, if it needs any."""
        return None

    def accelerate(
        self, velocity: Float[Array, "vertices 3 batch"], h: float
    ) -> Float[Array, "vertices 3 batch"]:
        """Velocities [m/s] after external forces have acted for ``h`` [s]."""
        return velocity

    def begin(self, base: Float[Array, "vertices 3 batch"], start: Any, end: Any) -> Any:
        """What `project` needs for a block (a pytree; None for nothing).

        Args:
            base: Cloth positions at the block's start [m].
            start: The attached points at the block's start, a `Placed` or None.
            end: The same at its end.
        """
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
