"""The inference pipeline: prediction, then the post-processing steps of the dresser."""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..garment import skin_garment
from ..models import BoundGarment, dress_frames
from ._dresser import Dresser
from ._guided import GuidedState, Posed, advance_guided, init_guided
from .postprocess import Cloth, apply_contacts, apply_strain


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
    return apply_contacts(dresser.colliders, dresser.layers, cloth, rotations, translations)


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
    state: GuidedState | None = None,
) -> tuple[Cloth, Cloth, GuidedState | None]:
    """Computes garments in successive frames; pure, jit-able, differentiable.

    Args:
        dresser: From `make_dresser`.
        rotations: World rotations of joints, with `Dresser.history_length` frames before
            the first one requested.
        translations: World translations of joints in the same frames [m].
        fps: Frames per second.
        state: Simulated cloth in the frame before, for a dresser that simulates; if None, it starts
            as predicted.

    Returns:
        Garments before collision resolution (fine meshes at their sites), the result [m], and
        simulated cloth in the last frame.
    """
    first = dresser.history_length(fps)
    r, t = rotations[first:], translations[first:]
    predicted = predict_cloth(dresser, rotations, translations, fps)
    if dresser.guided is None:
        raw = limit(dresser, predicted, r, t)
        return raw, dresser.expand(resolve(dresser, raw, r, t), r, t), None
    scene, worn = dresser.guided, dresser.worn
    if state is None:
        state = init_guided(scene, rotations[first - 1], translations[first - 1])

    def step(s: GuidedState, frame: tuple[Posed, Array, Array]) -> tuple[GuidedState, Posed]:
        return advance_guided(scene, worn, s, *frame, fps)

    state, cloth = jax.lax.scan(jax.checkpoint(step), state, (predicted, r, t))
    return cloth, dresser.expand(cloth, r, t), state


@functools.partial(jax.jit, static_argnames="fps")
def infer_block(
    dresser: Dresser,
    rotations: Float[Array, "padded joints 3 3"],
    translations: Float[Array, "padded joints 3"],
    fps: float,
    state: GuidedState | None = None,
) -> tuple[Cloth, Cloth, GuidedState | None]:
    """`infer`, compiled once per block size."""
    return infer(dresser, jnp.asarray(rotations), jnp.asarray(translations), fps, state)
