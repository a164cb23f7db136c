"""Garments posed by linear blend skinning."""

import dataclasses

from jaxtyping import Array, Float

from ..body import skin_points
from ..typing import pytree
from ._garment import Garment


@pytree
@dataclasses.dataclass(frozen=True)
class SkinnedGarment:
    """A garment on a body shape, posed by skinning.

    Attributes:
        rest: Garment vertices at rest [m], shape [vertices, 3].
        skin: Their skinning weights, shape [vertices, joints].
        template: The template whose map dresses the garment.
        name: Name of the garment.
    """

    rest: Float[Array, "vertices 3"]
    skin: Float[Array, "vertices joints"]
    template: str = dataclasses.field(metadata={"static": True})
    name: str = dataclasses.field(metadata={"static": True})


def make_skinned(garment: Garment, rest: Float[Array, "all 3"]) -> SkinnedGarment:
    """Makes a skinned garment for a body shape.

    Args:
        garment: The garment.
        rest: `Body.rest_vertices` of the shape [m].
    """
    return SkinnedGarment(garment.rest_vertices(rest), garment.skin, garment.template, garment.name)


def skin_garment(
    garment: SkinnedGarment,
    rotations: Float[Array, "joints 3 3"],
    translations: Float[Array, "joints 3"],
) -> Float[Array, "vertices 3"]:
    """Poses a garment by linear blend skinning alone, as the baseline; positions in [m].

    Args:
        garment: The garment.
        rotations: World rotations of joints.
        translations: World translations of joints [m].
    """
    return skin_points(garment.rest, garment.skin, rotations, translations)[0]
