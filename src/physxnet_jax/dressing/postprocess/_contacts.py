"""Collisions with the body, then between garments."""

from jaxtyping import Array, Float

from ._collisions import BodyCollider, apply_collisions
from ._layers import Layer, apply_layers
from ._outfit import Cloth


def apply_contacts(
    colliders: tuple[BodyCollider, ...] | None,
    layers: tuple[Layer, ...] | None,
    cloth: Cloth,
    rotations: Float[Array, "frames joints 3 3"],
    translations: Float[Array, "frames joints 3"],
) -> Cloth:
    """Resolves collisions with the body and between layers [m]; None leaves a step out."""
    if colliders is not None:
        cloth = apply_collisions(colliders, cloth, rotations, translations)
    if layers is not None:
        cloth = apply_layers(layers, cloth, rotations, translations)
    return cloth
