"""Dressing live: a frame in, a frame out."""

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..geometry import relax
from ..typing import pytree
from ._features import point_features, skin_points
from ._predictor import Predictor, normalise
from ._wearable import Wearable, place_sampled


@pytree
@dataclasses.dataclass(frozen=True)
class Stream:
    """What is remembered from frame to frame.

    Attributes:
        points: Skinned texel points of the last ``config.inputs.window - 1`` frames [m],
            oldest first, shape [window - 1, texels, 3].
    """

    points: Float[Array, "lead texels 3"]


def start_stream(
    predictor: Predictor,
    rotations: Float[Array, "lead joints 3 3"] | Float[Array, "joints 3 3"],
    translations: Float[Array, "lead joints 3"] | Float[Array, "joints 3"],
) -> Stream:
    """A stream of a person who has done this until now.

    Args:
        predictor: The network.
        rotations: World rotations of joints in the ``config.inputs.window - 1`` frames
            before the first, oldest first; or in one pose, in which the person stood.
        translations: World translations of joints [m], likewise.
    """
    surface = predictor.surface
    lead = predictor.config.inputs.window - 1
    if rotations.ndim == 3:
        rotations = jnp.broadcast_to(rotations, (lead, *rotations.shape))
        translations = jnp.broadcast_to(translations, (lead, *translations.shape))
    points = jax.vmap(lambda r, t: skin_points(surface.rest, surface.weights, r, t)[0])
    return Stream(points(rotations, translations))


def stream_frame(
    predictor: Predictor,
    wearables: Sequence[Wearable],
    stream: Stream,
    rotations: Float[Array, "joints 3 3"],
    translations: Float[Array, "joints 3"],
    fps: float,
) -> tuple[Stream, tuple[Float[Array, "vertices 3"], ...]]:
    """The next frame's garments [m]; pure, and the same as `dress_frames` of the clip.

    Each pose is skinned once, whatever the window. Under `jax.jit` donate ``stream``.

    Args:
        predictor: The network.
        wearables: What is worn.
        stream: From `start_stream` or the frame before.
        rotations: World rotations of joints in this frame.
        translations: World translations of joints [m], likewise.
        fps: Frames a second.

    Returns:
        The stream for the next frame, and positions of each garment.

    Example:
        >>> import jax
        >>> step = jax.jit(stream_frame, static_argnames="fps", donate_argnames="stream")
    """
    surface, inputs = predictor.surface, predictor.config.inputs
    points, blend = skin_points(surface.rest, surface.weights, rotations, translations)
    window = jnp.concatenate([stream.points, points[None]])
    features = point_features(window, blend[None], fps, inputs)
    features = normalise(features, predictor.normalisation, inputs)
    templates = tuple(dict.fromkeys(w.template for w in wearables))
    offsets = predictor.from_features(features, templates)
    worn = []
    for w in wearables:
        sampled = w.sample(offsets[w.template][0])
        x = place_sampled(w, rotations, translations, sampled, predictor.config.family)
        worn.append(relax(w.springs, x, predictor.relaxation))
    return Stream(window[1:]), tuple(worn)
