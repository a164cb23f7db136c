"""Garments bound to an atlas, and dressing as a pure function."""

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..body import Body, skin_points
from ..garment import Garment, SkinnedGarment
from ..geometry import Smoothing, gaussian_smoothing, polar_rotation
from ..typing import pytree
from ..uv import Binding, dress_body
from ._features import Family, FeatureConfig, clip_features
from ._networks import Modulation
from ._predictor import Predictor, normalise

# Distance along the cloth over which offsets are averaged [m]: texels are wider than the vertex
# spacing, and a skirt also samples the maps of both legs, whose edges don't meet.
_SMOOTHING, _SMOOTHING_SKIRT = 0.015, 0.03


@pytree
@dataclasses.dataclass(frozen=True)
class BoundGarment(SkinnedGarment):
    """A garment bound to an atlas on a body shape.

    Attributes:
        binding: Texels that the vertices sample, and the body points they belong to.
        anchor: Those body points at rest [m], shape [vertices, 3].
        anchor_weights: Their skinning weights, shape [vertices, joints].
        smoothing: Averages sampled offsets over neighbouring vertices; None to sample maps as they
            are.
        modulation: What the garment changes in its decoder, see `Predictor.modulation`; None for
            networks that don't see the garment.
    """

    binding: Binding
    anchor: Float[Array, "vertices 3"]
    anchor_weights: Float[Array, "vertices joints"]
    smoothing: Smoothing | None
    modulation: Modulation | None = None

    def sample(
        self, values: Float[Array, "*batch texels channels"]
    ) -> Float[Array, "*batch vertices channels"]:
        """Texel values sampled at the garment's vertices."""
        sampled = self.binding.sample(values)
        return sampled if self.smoothing is None else self.smoothing @ sampled


def bind_garment(
    body: Body,
    rest: Float[Array, "all 3"],
    garment: Garment,
    binding: Binding,
    *,
    smooth: bool = True,
) -> BoundGarment:
    """Prepares a garment to be dressed on a body shape.

    Args:
        body: The body.
        rest: `Body.rest_vertices` of that shape [m].
        garment: The garment.
        binding: Binding of its vertices to an atlas, see `bind`.
        smooth: Average sampled offsets over the cloth, for maps that are too coarse for folds.

    Returns:
        The bound garment, as `dress_frames` takes it.
    """
    base, radius = rest, _SMOOTHING
    if garment.template == "dress":
        base = jax.device_put(dress_body(body, np.asarray(rest)).astype(np.float32))
        radius = _SMOOTHING_SKIRT
    mesh = garment.mesh
    smoothing = None
    if smooth:
        smoothing = gaussian_smoothing(np.asarray(mesh.vertices), np.asarray(mesh.faces), radius)
    return BoundGarment(
        garment.rest_vertices(rest),
        garment.skin,
        garment.template,
        garment.name,
        binding,
        binding.to_body @ base,
        binding.to_body @ body.weights,
        smoothing,
    )


def apply_offsets(
    bound: BoundGarment,
    rotations: Float[Array, "joints 3 3"],
    translations: Float[Array, "joints 3"],
    offsets: Float[Array, "texels 3"],
    family: Family,
) -> Float[Array, "vertices 3"]:
    """Garment vertices [m] in a pose, from a predicted map.

    Args:
        bound: The garment.
        rotations: World rotations of joints.
        translations: World translations of joints [m].
        offsets: Predicted offsets of covered texels [m].
        family: How to interpret them, see `Predictor`.

    Returns:
        Vertex positions [m]. With zero offsets, ``local`` gives exactly the skinning.

    References:
        PhysXNet, equations 3 and 9.
    """
    return apply_sampled_offsets(bound, rotations, translations, bound.sample(offsets), family)


def apply_sampled_offsets(
    bound: BoundGarment,
    rotations: Float[Array, "joints 3 3"],
    translations: Float[Array, "joints 3"],
    sampled: Float[Array, "vertices 3"],
    family: Family,
) -> Float[Array, "vertices 3"]:
    """`apply_offsets` from offsets that are already sampled at the vertices [m]."""
    if family == "paper":
        points, _ = skin_points(bound.anchor, bound.anchor_weights, rotations, translations)
        return points + sampled
    points, blend = skin_points(bound.rest, bound.skin, rotations, translations)
    return points + jnp.sum(polar_rotation(blend) * sampled[:, None], axis=2)


def dress_frames(
    predictor: Predictor,
    bound_garments: Sequence[BoundGarment],
    rotations: Float[Array, "padded joints 3 3"],
    translations: Float[Array, "padded joints 3"],
    fps: float,
) -> tuple[Float[Array, "frames vertices 3"], ...]:
    """Dressed garments [m] in successive frames; pure, jittable, differentiable.

    Args:
        predictor: The network.
        bound_garments: Garments to dress.
        rotations: World rotations of joints, with ``config.inputs.at_rate(fps).window - 1`` frames
            before the first output frame (see `pad_clip`).
        translations: World translations of joints [m], likewise.
        fps: Frames per second.

    Returns:
        Vertex positions of each garment [m].
    """
    inputs = predictor.config.inputs
    points = predictor.texel_points
    features = clip_features(points.rest, points.weights, rotations, translations, fps, inputs)
    sampled = predict_sampled(
        predictor, bound_garments, normalise(features, predictor.normalisation, inputs)
    )
    family: Family = predictor.config.family
    last = slice(inputs.at_rate(fps).window - 1, None)
    return tuple(
        jax.vmap(lambda r, t, o, w=w: apply_sampled_offsets(w, r, t, o, family))(
            rotations[last], translations[last], offsets
        )
        for w, offsets in zip(bound_garments, sampled, strict=True)
    )


def predict_sampled(
    predictor: Predictor,
    bound_garments: Sequence[BoundGarment],
    features: Float[Array, "batch texels channels"],
) -> tuple[Float[Array, "batch vertices 3"], ...]:
    """Offsets [m] at the vertices of garments, from normalised features, in one pass.

    Garments of one template have one map, unless the network sees the garment.
    """
    out: dict[int, Array] = {}
    waiting = list(enumerate(bound_garments))
    while waiting:
        # The compiler computes the encoder, which all rounds share, once.
        now: dict[str, tuple[int, BoundGarment]] = {}
        for k, w in waiting:
            now.setdefault(w.template, (k, w))
        known = {t: w.modulation for t, (_, w) in now.items() if w.modulation is not None}
        offsets = predictor.from_features(features, tuple(now), known or None)
        served = [k for k, w in waiting if not known or now[w.template][0] == k]
        out |= {k: bound_garments[k].sample(offsets[bound_garments[k].template]) for k in served}
        waiting = [(k, w) for k, w in waiting if k not in out]
    return tuple(out[k] for k in range(len(bound_garments)))


def pad_clip(
    values: Float[Array, "frames ..."], inputs: FeatureConfig
) -> Float[Array, "padded ..."]:
    """A clip with copies of its first frame prepended, as many as ``inputs`` need.

    Args:
        values: Joint rotations or translations of each frame.
        inputs: Features of the network.

    Returns:
        The clip with ``inputs.window - 1`` static frames before it.
    """
    return jnp.concatenate([jnp.repeat(values[:1], inputs.window - 1, axis=0), values])
