"""The input from which every post-processing step is prepared."""

import dataclasses

from jaxtyping import Array, Float

from ...body import Body
from ...garment import Garment, SkinnedGarment

Cloth = tuple[Float[Array, "frames _ 3"], ...]
"""Vertices of each garment [m]."""


@dataclasses.dataclass(frozen=True)
class Outfit:
    """Garments worn together on a body shape.

    Attributes:
        body: The body.
        rest: Its rest vertices [m], shape [all, 3].
        worn: Garments on that shape.
        garments: The same garments with their meshes, on the default shape.
    """

    body: Body
    rest: Float[Array, "all 3"]
    worn: tuple[SkinnedGarment, ...]
    garments: tuple[Garment, ...]
