"""The predictor: network, normalisation and atlas as one."""

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Bool, Float

from ..body import Body
from ..typing import pytree
from ..uv import Atlas, dress_body
from ._features import Family, Inputs, clip_features
from ._networks import Generator

# Normalised lengths beyond this are no motion of a person's and no cloth of theirs; of 0.1 %
# of texels in training a component exceeds 1. Places are in metres.
_FARTHEST = 3.0
# Half a texel of the largest atlas is wider than this [m].
_SAME_PLACE = 0.005
RELAXATION = 8
"""Steps after which edges are about as far from their lengths as in simulations."""


@dataclasses.dataclass(frozen=True)
class ModelConfig:
    """Everything that decides what a network is.

    Attributes:
        inputs: What it sees of the motion, and in which frame it answers.
        resolution: Texels a side, a multiple of 16.
        width: Channels of the first layer.
        templates: Templates with a decoder.
    """

    inputs: Inputs = dataclasses.field(default_factory=Inputs)
    resolution: int = 128
    width: int = 32
    templates: tuple[str, ...] = ("top", "bottom", "dress")

    @property
    def family(self) -> Family:
        """``paper`` (world frame) or ``local`` (each texel's own frame)."""
        return self.inputs.family


@pytree
@dataclasses.dataclass(frozen=True)
class Normalisation:
    """Scales that bring each kind of map to [-1, 1], from the training set.

    Attributes:
        velocity: [m/s].
        acceleration: [m/s^2].
        offset: Of each template [m].
    """

    velocity: Float[Array, ""]
    acceleration: Float[Array, ""]
    offset: dict[str, Float[Array, ""]]


@pytree
@dataclasses.dataclass(frozen=True)
class Surface:
    """The texels of an atlas on a body shape.

    Attributes:
        rest: Texel points at rest [m], shape [texels, 3].
        rest_dress: The same on the body with joined legs.
        weights: Skinning weights, shape [texels, joints].
        valid: Texels that each template covers, shape [texels].
    """

    rest: Float[Array, "texels 3"]
    rest_dress: Float[Array, "texels 3"]
    weights: Float[Array, "texels joints"]
    valid: dict[str, Bool[Array, " texels"]]


def make_surface(
    atlas: Atlas,
    body: Body,
    rest: Float[Array, "all 3"],
    valid: dict[str, Bool[Array, " texels"]],
) -> Surface:
    """Texels on a body shape.

    Args:
        atlas: The atlas.
        body: The body.
        rest: Its rest vertices [m].
        valid: Texels that each template covers.
    """
    joined = jnp.asarray(dress_body(body, np.asarray(rest)).astype(np.float32))
    return Surface(
        atlas.to_body @ rest, atlas.to_body @ joined, atlas.to_body @ body.weights, valid
    )


@pytree
@dataclasses.dataclass(frozen=True)
class Predictor:
    """A trained network with all it needs to answer.

    Attributes:
        atlas: The atlas whose texels it speaks of.
        surface: Those texels on a body.
        normalisation: Scales of its inputs and outputs.
        state: Parameters and statistics of the network.
        graph: Structure of the network.
        config: What the network is.
        mirrored: Whether the network is asked for the mirrored person too, see
            `ask_mirrored`.
        relaxation: Steps by which dressed cloth is brought back to its lengths, see
            `relax_cloth`.
    """

    atlas: Atlas
    surface: Surface
    normalisation: Normalisation
    state: nnx.State
    graph: nnx.GraphDef = dataclasses.field(metadata={"static": True})
    config: ModelConfig = dataclasses.field(metadata={"static": True})
    mirrored: bool = dataclasses.field(default=False, metadata={"static": True})
    relaxation: int = dataclasses.field(default=0, metadata={"static": True})

    def __call__(
        self,
        rotations: Float[Array, "padded joints 3 3"],
        translations: Float[Array, "padded joints 3"],
        fps: float,
        templates: Sequence[str],
    ) -> dict[str, Float[Array, "frames texels 3"]]:
        """Offsets [m] of successive frames.

        ``local``: the change of the offset at rest, in each cloth point's own frame.
        ``paper``: the offset from skin to cloth, in the world's frame. Only the
        decoders of ``templates`` are computed.

        Args:
            rotations: World rotations of joints, with `Inputs.window` - 1 frames before the
                first one wanted (see `pad_clip`).
            translations: World translations of joints [m], likewise.
            fps: Frames a second.
            templates: Which maps.

        Returns:
            Offsets of covered texels; zero where the template doesn't reach.
        """
        features = clip_features(
            self.surface.rest,
            self.surface.weights,
            rotations,
            translations,
            fps,
            self.config.inputs,
        )
        features = normalise(features, self.normalisation, self.config.inputs)
        return self.from_features(features, templates)

    def from_features(
        self, features: Float[Array, "batch texels channels"], templates: Sequence[str]
    ) -> dict[str, Float[Array, "batch texels 3"]]:
        """Offsets [m] from normalised features, see `normalise`."""
        network = nnx.merge(self.graph, self.state)
        network.eval()
        # All parameters have one type: float32, or what `at_precision` made of it.
        dtype = jax.tree.leaves(self.state)[0].dtype
        maps = self.atlas.to_map(features).astype(dtype)
        if self.mirrored:
            maps = jnp.concatenate([maps, _mirror_maps(maps)])
        out = network(maps, tuple(templates))
        return {
            t: jnp.where(
                self.surface.valid[t][None, :, None],
                self._answers(m, t).astype(jnp.float32) * self.normalisation.offset[t],
                0.0,
            )
            for t, m in out.items()
        }

    def _answers(
        self, maps: Float[Array, "all height width 3"], template: str
    ) -> Float[Array, "batch texels 3"]:
        """What maps say of texels; the mean of both answers where there are two."""
        if not self.mirrored:
            return _shortened(self.atlas.from_map(maps))
        plain, twin = jnp.split(maps, 2)
        plain, twin = (_shortened(self.atlas.from_map(m)) for m in (plain, _mirror_maps(twin)))
        # Where the mirror image isn't covered there is one answer alone.
        covered = self.surface.valid[template].astype(plain.dtype)[:, None]
        share = 0.5 * self.atlas.from_map(self.atlas.to_map(covered)[:, ::-1])[None]
        return plain + share * (twin - plain)


def _mirror_maps(
    maps: Float[Array, "batch height width channels"],
) -> Float[Array, "batch height width channels"]:
    """Maps of vectors as a mirror shows the person: the chart's halves mirror each other.

    Holds for vectors in the world's axes and in those of a texel's own frame alike.
    """
    channels = maps.shape[-1]
    signs = jnp.asarray(np.where(np.arange(channels) % 3 == 0, -1.0, 1.0), maps.dtype)
    return maps[:, :, ::-1] * signs[None, None, None]


def ask_mirrored(predictor: Predictor) -> Predictor:
    """A predictor that asks its network for the mirrored person too, and averages.

    Twice the network's work for each frame. What it answers to a mirrored motion is the
    mirrored answer, but for where the chart's halves aren't each other's mirror image to
    the texel (garments differ by a quarter of a millimetre, single vertices by two).

    Args:
        predictor: A predictor on the built-in body's chart, whose halves are each other's
            mirror image.

    Raises:
        ValueError: The halves of the atlas aren't.
    """
    atlas = predictor.atlas
    places = np.asarray(atlas.to_map(predictor.surface.rest))
    twins = places[:, ::-1] * np.array([-1.0, 1.0, 1.0])
    mask = np.asarray(atlas.mask)
    both = mask & mask[:, ::-1]
    away = np.linalg.norm(places - twins, axis=-1)[both]
    if both.sum() < 0.99 * mask.sum() or np.quantile(away, 0.99) > _SAME_PLACE:
        raise ValueError("the halves of the atlas aren't mirror images; ask plainly.")
    return dataclasses.replace(predictor, mirrored=True)


def relax_cloth(predictor: Predictor, steps: int = RELAXATION) -> Predictor:
    """A predictor whose cloth is brought back to the lengths of its edges.

    A network says where cloth is, to about a texel; edges come out up to half as long
    again, and folds are lost. Few steps of `relax` mend that, and move the cloth as a
    whole by next to nothing.

    Args:
        predictor: Any predictor.
        steps: Of `relax`; with 0 nothing is computed.

    Raises:
        ValueError: A negative number of steps.
    """
    if steps < 0:
        raise ValueError(f"steps is {steps}; cloth relaxes by 0 steps or more.")
    return dataclasses.replace(predictor, relaxation=steps)


def normalise(
    features: Float[Array, "*batch texels channels"],
    normalisation: Normalisation,
    inputs: Inputs,
) -> Float[Array, "*batch texels channels"]:
    """Features scaled to about [-1, 1], each kind by itself (PhysXNet, section 5.1).

    A vector longer than `_FARTHEST` is shortened to it: a teleport is taken for a very
    fast motion, not for one that no training could have shown. Finite features stay
    finite, and so do gradients.
    """
    one = jnp.ones((), jnp.float32)
    scales = {"velocity": normalisation.velocity, "acceleration": normalisation.acceleration}
    out, start = [], 0
    for kind in inputs.kinds:
        values = features[..., start : start + inputs.width(kind)] / scales.get(kind, one)
        out.append(_shortened(values))
        start += inputs.width(kind)
    return jnp.concatenate(out, axis=-1)


def _shortened(values: Float[Array, "*batch channels"]) -> Float[Array, "*batch channels"]:
    vectors = values.reshape(*values.shape[:-1], -1, 3)
    # Scaled first: the square of a huge number must not overflow. The scale cancels, so its
    # derivative isn't wanted; that of a maximum is 0/0 where a compiler rounds the values anew.
    largest = jax.lax.stop_gradient(jnp.max(jnp.abs(vectors), axis=-1, keepdims=True))
    far = largest > _FARTHEST
    shrunk = vectors / jnp.where(far, largest, jnp.ones_like(largest))
    squared = jnp.sum(shrunk * shrunk, axis=-1, keepdims=True)
    over = far | (squared > _FARTHEST**2)
    length = jnp.sqrt(jnp.where(over, squared, jnp.ones_like(squared)))
    return jnp.where(over, _FARTHEST * shrunk / length, vectors).reshape(values.shape)


def make_generator(config: ModelConfig, *, seed: int = 0) -> Generator:
    """A generator with fresh parameters."""
    return Generator(
        config.inputs.channels,
        config.templates,
        width=config.width,
        rngs=nnx.Rngs(seed),
    )
