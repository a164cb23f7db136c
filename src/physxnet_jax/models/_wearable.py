"""Garments bound to an atlas, and dressing as a pure function."""

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..body import Body
from ..garment import Garment
from ..geometry import (
    Smoothing,
    Springs,
    each_frame,
    gaussian_smoothing,
    make_springs,
    polar_rotation,
    relax,
)
from ..typing import pytree
from ..uv import Binding, dress_body
from ._features import Family, Inputs, skin_points
from ._predictor import Predictor

_EXACT = jax.lax.Precision.HIGHEST
# Texels are wider than the gaps between vertices; a skirt also samples maps of both legs,
# whose edges don't meet. Offsets are averaged over about this distance along the cloth [m].
_SMOOTH, _SMOOTH_SKIRT = 0.015, 0.03


@pytree
@dataclasses.dataclass(frozen=True)
class Wearable:
    """A garment bound to an atlas, on a body shape: all that dressing needs.

    Attributes:
        rest: Garment vertices at rest [m], shape [vertices, 3].
        skin: Their skinning weights, shape [vertices, joints].
        binding: Texels they sample and body points they belong to.
        anchor: Body points at rest that the binding names [m], shape [vertices, 3].
        anchor_weights: Their skinning weights, shape [vertices, joints].
        smoothing: Means over neighbourhoods that sampled offsets pass.
        springs: Lengths of its edges at rest.
        template: The map this garment is dressed by.
        name: Name of the garment.
    """

    rest: Float[Array, "vertices 3"]
    skin: Float[Array, "vertices joints"]
    binding: Binding
    anchor: Float[Array, "vertices 3"]
    anchor_weights: Float[Array, "vertices joints"]
    smoothing: Smoothing
    springs: Springs
    template: str = dataclasses.field(metadata={"static": True})
    name: str = dataclasses.field(metadata={"static": True})

    def sample(
        self, values: Float[Array, "*batch texels channels"]
    ) -> Float[Array, "*batch vertices channels"]:
        """Texel values carried to the garment's vertices."""
        return self.smoothing @ self.binding.sample(values)


def make_wearable(
    body: Body, rest: Float[Array, "all 3"], garment: Garment, binding: Binding
) -> Wearable:
    """A garment ready to be dressed on a body shape.

    Args:
        body: The body.
        rest: `Body.rest_vertices` of that shape [m].
        garment: What is worn.
        binding: Of its vertices to an atlas, see `bind`.

    Returns:
        The garment as `dress_frames` takes it.
    """
    base, radius = rest, _SMOOTH
    if garment.template == "dress":
        base = jnp.asarray(dress_body(body, np.asarray(rest)).astype(np.float32))
        radius = _SMOOTH_SKIRT
    mesh = garment.mesh
    smoothing = gaussian_smoothing(np.asarray(mesh.vertices), np.asarray(mesh.faces), radius)
    worn = garment.rest_vertices(rest)
    return Wearable(
        worn,
        garment.skin,
        binding,
        binding.to_body @ base,
        binding.to_body @ body.weights,
        smoothing,
        make_springs(np.asarray(worn), np.asarray(mesh.faces)),
        garment.template,
        garment.name,
    )


def skin_wearable(
    wearable: Wearable,
    rotations: Float[Array, "joints 3 3"],
    translations: Float[Array, "joints 3"],
) -> Float[Array, "vertices 3"]:
    """The garment by linear blend skinning alone [m]: the baseline."""
    return skin_points(wearable.rest, wearable.skin, rotations, translations)[0]


def apply_offsets(
    wearable: Wearable,
    rotations: Float[Array, "joints 3 3"],
    translations: Float[Array, "joints 3"],
    offsets: Float[Array, "texels 3"],
    family: Family,
) -> Float[Array, "vertices 3"]:
    """Garment vertices [m] in a pose, from a predicted map.

    Args:
        wearable: The garment.
        rotations: World rotations of joints.
        translations: World translations of joints [m].
        offsets: Predicted offsets of covered texels [m].
        family: How to read them, see `Predictor`.

    Returns:
        Vertex positions. With zero offsets, ``local`` gives exactly the skinning.

    References:
        PhysXNet, equations 3 and 9.
    """
    return place_sampled(wearable, rotations, translations, wearable.sample(offsets), family)


def place_sampled(
    wearable: Wearable,
    rotations: Float[Array, "joints 3 3"],
    translations: Float[Array, "joints 3"],
    sampled: Float[Array, "vertices 3"],
    family: Family,
) -> Float[Array, "vertices 3"]:
    """The same as `apply_offsets`, from offsets already carried to the vertices [m]."""
    if family == "paper":
        points, _ = skin_points(wearable.anchor, wearable.anchor_weights, rotations, translations)
        return points + sampled
    points, blend = skin_points(wearable.rest, wearable.skin, rotations, translations)
    turned = jnp.einsum("vab,vb->va", polar_rotation(blend), sampled, precision=_EXACT)
    return points + turned


def dress_frames(
    predictor: Predictor,
    wearables: Sequence[Wearable],
    rotations: Float[Array, "padded joints 3 3"],
    translations: Float[Array, "padded joints 3"],
    fps: float,
) -> tuple[Float[Array, "frames vertices 3"], ...]:
    """Dressed garments [m] of successive frames; pure, jit-able, differentiable.

    Args:
        predictor: The network.
        wearables: What is worn.
        rotations: World rotations of joints, with ``config.inputs.window - 1`` frames
            before the first one wanted (see `pad_clip`).
        translations: World translations of joints [m], likewise.
        fps: Frames a second.

    Returns:
        Positions of each garment.
    """
    templates = tuple(dict.fromkeys(w.template for w in wearables))
    offsets = predictor(rotations, translations, fps, templates)
    family: Family = predictor.config.family
    last = slice(predictor.config.inputs.window - 1, None)
    placed = (
        jax.vmap(lambda r, t, o, w=w: place_sampled(w, r, t, o, family))(
            rotations[last], translations[last], w.sample(offsets[w.template])
        )
        for w in wearables
    )
    if not predictor.relaxation:
        return tuple(placed)
    return tuple(
        each_frame(lambda x, s=w.springs: relax(s, x, predictor.relaxation), x)
        for w, x in zip(wearables, placed, strict=True)
    )


def pad_clip(values: Float[Array, "frames ..."], inputs: Inputs) -> Float[Array, "padded ..."]:
    """A clip with its first frame repeated before itself, as often as ``inputs`` need.

    Args:
        values: Of each frame: joints' rotations, or their translations.
        inputs: What the network sees.

    Returns:
        ``inputs.window - 1`` frames more: of a person who stood still until the first one.
    """
    return jnp.concatenate([jnp.repeat(values[:1], inputs.window - 1, axis=0), values])


def pose_windows(
    values: Float[Array, "frames ..."] | Float[np.ndarray, "frames ..."], inputs: Inputs
) -> Float[Array, "frames window ..."] | Float[np.ndarray, "frames window ..."]:
    """The last poses up to each frame; the first one is repeated before itself."""
    frames = values.shape[0]
    index = np.arange(frames)[:, None] + np.arange(1 - inputs.window, 1)[None]
    return values[np.maximum(index, 0)]
