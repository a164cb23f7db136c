"""The inference pipeline: prediction, then the post-processing steps of the dresser."""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..garment import skin_garment
from ..models import BoundGarment, dress_frames
from ._dresser import Dresser
from .postprocess import Cloth, apply_collisions, apply_layers, apply_strain


def bound(dresser: Dresser) -> tuple[BoundGarment, ...]:
    """Garments of the dresser that are bound to a network's atlas."""
    return tuple(w for w in dresser.worn if isinstance(w, BoundGarment))


def predict_cloth(
    dresser: Dresser,
    rotations: Float[Array, "padded joints 3 3"],
    translations: Float[Array, "padded joints 3"],
    fps: float,
) -> Cloth:
    """Predicts garments [m], by network or skinning alone; `infer` without post-processing."""
    if dresser.predictor is None:
        return tuple(
            jax.vmap(functools.partial(skin_garment, w))(rotations, translations)
            for w in dresser.worn
        )
    return dress_frames(dresser.predictor, bound(dresser), rotations, translations, fps)


def resolve(
    dresser: Dresser,
    cloth: Cloth,
    rotations: Float[Array, "frames joints 3 3"],
    translations: Float[Array, "frames joints 3"],
) -> Cloth:
    """Resolves collisions with the body and between layers [m], if requested."""
    if dresser.colliders is not None:
        cloth = apply_collisions(dresser.colliders, cloth, rotations, translations)
    if dresser.layers is not None:
        cloth = apply_layers(dresser.layers, cloth, rotations, translations)
    return cloth


def limit(
    dresser: Dresser,
    cloth: Cloth,
    rotations: Float[Array, "frames joints 3 3"],
    translations: Float[Array, "frames joints 3"],
) -> Cloth:
    """Limits the strain of garments [m], if requested."""
    if dresser.strain is None:
        return cloth
    return apply_strain(dresser.strain, cloth, rotations, translations)


def infer(
    dresser: Dresser,
    rotations: Float[Array, "padded joints 3 3"],
    translations: Float[Array, "padded joints 3"],
    fps: float,
) -> tuple[Cloth, Cloth]:
    """Computes garments in successive frames; pure, jit-able, differentiable.

    Args:
        dresser: From `make_dresser`.
        rotations: World rotations of joints, with `Dresser.history_length` frames before
            the first one requested.
        translations: World translations of joints in the same frames [m].
        fps: Frames per second.

    Returns:
        Garments before collision resolution, and the result [m].
    """
    first = dresser.history_length
    r, t = rotations[first:], translations[first:]
    raw = limit(dresser, predict_cloth(dresser, rotations, translations, fps), r, t)
    return raw, resolve(dresser, raw, r, t)


@functools.partial(jax.jit, static_argnames="fps")
def infer_block(
    dresser: Dresser,
    rotations: Float[Array, "padded joints 3 3"],
    translations: Float[Array, "padded joints 3"],
    fps: float,
) -> tuple[Cloth, Cloth]:
    """`infer`, compiled once per block size."""
    return infer(dresser, jnp.asarray(rotations), jnp.asarray(translations), fps)
