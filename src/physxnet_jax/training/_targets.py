"""Targets at texels, and the scales that normalise maps to [-1, 1]."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..body import skin_points
from ..data import QUANTIZATION_STEP, Frames
from ..models import PAPER, Family, Normalisation, TexelPoints, clip_features
from ..uv import Transference


def target_offsets(
    target: Array,
    to_cloth: Transference,
    garment_rest: Array,
    skin: Array,
    anchor: Array,
    anchor_weights: Array,
    rotations: Array,
    translations: Array,
    family: Family,
) -> Float[Array, "batch texels 3"]:
    """Targets at texels [m] from stored vertex offsets.

    ``paper`` adds the skinning back and subtracts the skin at the texel (I_C of equation 9);
    ``local`` needs neither.
    """
    offset = target.astype(jnp.float32) * QUANTIZATION_STEP
    if family == "local":
        return to_cloth @ offset

    def one(o: Array, r: Array, t: Array) -> Array:
        cloth = skin_points(garment_rest, skin, r, t)[0] + o
        return to_cloth @ cloth - skin_points(anchor, anchor_weights, r, t)[0]

    return jax.vmap(one)(offset, rotations, translations)


def measure_normalisation(
    frames: Frames,
    texel_points: TexelPoints,
    offsets_of: dict[str, Array],
    *,
    samples: int = 128,
    seed: int = 0,
) -> Normalisation:
    """Scales from a sample of the training frames: 99.9 % of values lie in [-1, 1].

    Args:
        frames: Training frames.
        texel_points: Texels.
        offsets_of: Target offsets of sampled frames for each template [m].
        samples: Number of sampled frames.
        seed: Seed of the sample.

    Note (differs from the paper):
        A percentile instead of the largest value: one fast hand in one frame would
        otherwise squeeze all other motion into a few per cent of the range.
    """
    pick = np.random.default_rng(seed).choice(len(frames), min(samples, len(frames)), False)
    features_of = jax.jit(clip_features, static_argnames=("fps", "inputs"))
    # World axes, whatever frame the network uses: close enough for a scale.
    seen = dataclasses.replace(PAPER, frames=1)
    rows = [
        np.abs(
            features_of(
                texel_points.rest,
                texel_points.weights,
                frames.rotations[i, -seen.window :],
                frames.translations[i, -seen.window :],
                fps=frames.fps,
                inputs=seen,
            )[0]
        )
        for i in pick
    ]
    features = np.stack(rows)

    def scale(x: np.ndarray) -> Array:
        return jnp.asarray(max(float(np.quantile(x, 0.999)), 1e-6), jnp.float32)

    return Normalisation(
        scale(features[..., :3]),
        scale(features[..., 3:6]),
        {t: scale(np.abs(np.asarray(o))) for t, o in offsets_of.items()},
    )
