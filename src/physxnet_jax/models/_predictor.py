"""The predictor: a network with its normalisation and atlas."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Bool, Float

from .._programs import bounded_jit
from ..body import Body
from ..typing import pytree
from ..uv import CONDITIONS, Atlas, dress_body
from ._features import Family, FeatureConfig, clip_features
from ._networks import Generator, Modulation

# Largest plausible length of a normalised vector. In training, a component exceeds 1 at 0.1 % of
# texels. Positions are in metres.
_FARTHEST = 3.0
# Tolerance of mirror symmetry [m], less than half a texel of the largest atlas.
_MIRROR_TOLERANCE = 0.005


@dataclasses.dataclass(frozen=True)
class ModelConfig:
    """Everything that defines a network.

    Attributes:
        inputs: Features of the motion, and the frame of the predicted offsets.
        resolution: Texels per side of the maps of offsets; those of motion are a multiple of 16.
        width: Channels of the first layer.
        templates: Templates with a decoder.
        skirt_chart: Whether the maps have a chart for skirts, see `make_atlas`. Maps that have one
            are sampled as they are; others are smoothed over the cloth.
        finer: Whether the maps of offsets have twice the resolution of the maps of motion.
        conditions: Whether the network sees the garment, see `condition_maps`.
        fabrics: Fabrics that it learns from. It sees stiffer or heavier ones, which would lead it
            far astray, as the nearest of these.
    """

    inputs: FeatureConfig = dataclasses.field(default_factory=FeatureConfig)
    resolution: int = 128
    width: int = 32
    templates: tuple[str, ...] = ("top", "bottom", "dress")
    skirt_chart: bool = False
    finer: bool = False
    conditions: bool = False
    fabrics: tuple[str, ...] = ("cotton", "jersey", "silk")

    def __post_init__(self) -> None:
        if self.skirt_chart and self.family == "paper":
            raise ValueError("skirt_chart is for the family local; the paper's maps have none.")
        if (self.finer or self.conditions) and not self.skirt_chart:
            raise ValueError("finer and conditions need skirt_chart.")

    @property
    def family(self) -> Family:
        """``paper`` (world frame) or ``local`` (each texel's own frame)."""
        return self.inputs.family

    @property
    def motion_resolution(self) -> int:
        """Texels per side of the maps of motion."""
        return self.resolution // 2 if self.finer else self.resolution


@pytree
@dataclasses.dataclass(frozen=True)
class Normalisation:
    """Scales that map each kind of value to [-1, 1], measured on the training set.

    Attributes:
        velocity: Of velocities [m/s].
        acceleration: Of accelerations [m/s^2].
        offset: Of each template's offsets [m].
    """

    velocity: Float[Array, ""]
    acceleration: Float[Array, ""]
    offset: dict[str, Float[Array, ""]]


@pytree
@dataclasses.dataclass(frozen=True)
class TexelPoints:
    """The texels of an atlas as points on a body shape.

    Attributes:
        rest: Points of the texels of motion at rest [m], shape [texels, 3].
        rest_dress: The same on the body with joined legs, see `dress_body`.
        weights: Skinning weights, shape [texels, joints].
        valid: Texels of offsets that each template covers, shape [texels].
    """

    rest: Float[Array, "texels 3"]
    rest_dress: Float[Array, "texels 3"]
    weights: Float[Array, "texels joints"]
    valid: dict[str, Bool[Array, " covered"]]


def make_texel_points(
    atlas: Atlas,
    body: Body,
    rest: Float[Array, "all 3"],
    valid: dict[str, Bool[Array, " covered"]],
) -> TexelPoints:
    """The texels of an atlas on a body shape.

    Args:
        atlas: The atlas of the maps of motion.
        body: The body.
        rest: Its rest vertices [m].
        valid: Texels that each template covers.
    """
    joined = jax.device_put(dress_body(body, np.asarray(rest)).astype(np.float32))
    return TexelPoints(
        atlas.at_texels(rest), atlas.at_texels(joined), atlas.at_texels(body.weights), valid
    )


@pytree
@dataclasses.dataclass(frozen=True)
class Predictor:
    """A trained network with everything needed for prediction.

    Attributes:
        atlas: The atlas of the maps of offsets.
        texel_points: Its texels on a body.
        normalisation: Scales of inputs and outputs.
        state: Parameters and statistics of the network.
        graph: Structure of the network.
        config: Configuration of the network.
        mirror_tta: Whether to average with the prediction for the mirrored pose, see
            `with_mirror_tta`.
        coarse_atlas: The atlas of the maps of motion, where they are coarser.
    """

    atlas: Atlas
    texel_points: TexelPoints
    normalisation: Normalisation
    state: nnx.State
    graph: nnx.GraphDef = dataclasses.field(metadata={"static": True})
    config: ModelConfig = dataclasses.field(metadata={"static": True})
    mirror_tta: bool = dataclasses.field(default=False, metadata={"static": True})
    coarse_atlas: Atlas | None = None

    @property
    def motion_atlas(self) -> Atlas:
        """The atlas of the maps of motion."""
        return self.atlas if self.coarse_atlas is None else self.coarse_atlas

    @property
    def _dtype(self) -> jnp.dtype:
        """The type of all parameters: float32, or that set by `at_precision`."""
        return jax.tree.leaves(self.state)[0].dtype

    def modulation(
        self, template: str, conditions: Float[Array, "height width channels"]
    ) -> Modulation:
        """What the maps of a garment change in its decoder, see `condition_maps`.

        With test-time augmentation a batch of two: of the garment and of its mirror image.
        """
        maps = conditions[None].astype(self._dtype)
        if self.mirror_tta:
            maps = jnp.concatenate([maps, maps[:, :, ::-1]])
        return _modulation(self.graph, template, self.state, maps)

    def __call__(
        self,
        rotations: Float[Array, "padded joints 3 3"],
        translations: Float[Array, "padded joints 3"],
        fps: float,
        templates: Sequence[str],
        modulation: Mapping[str, Modulation] | None = None,
    ) -> dict[str, Float[Array, "frames texels 3"]]:
        """Offsets [m] of successive frames.

        ``local``: the offset from skinned to dressed cloth, in each cloth point's own frame.
        ``paper``: the offset from skin to cloth, in the world frame. Only the decoders of
        ``templates`` are computed.

        Args:
            rotations: World rotations of joints, with `FeatureConfig.window` - 1 frames, at this
                rate, before the first output frame (see `pad_clip`).
            translations: World translations of joints [m], likewise.
            fps: Frames per second.
            templates: Templates whose maps to predict.
            modulation: Of the garment of each template, see `modulation`. A network that sees
                garments has learned nothing without it.

        Returns:
            Offsets of covered texels; zero where the template doesn't cover them.
        """
        features = clip_features(
            self.texel_points.rest,
            self.texel_points.weights,
            rotations,
            translations,
            fps,
            self.config.inputs,
        )
        features = normalise(features, self.normalisation, self.config.inputs)
        return self.from_features(features, templates, modulation)

    def from_features(
        self,
        features: Float[Array, "batch texels channels"],
        templates: Sequence[str],
        modulation: Mapping[str, Modulation] | None = None,
    ) -> dict[str, Float[Array, "batch covered 3"]]:
        """Offsets [m] from normalised features, see `normalise`."""
        network = nnx.merge(self.graph, self.state)
        network.eval()
        maps = self.motion_atlas.to_map(features).astype(self._dtype)
        if self.mirror_tta:
            maps = jnp.concatenate([maps, _mirror_maps(maps)])
            modulation = jax.tree.map(lambda m: jnp.repeat(m, len(maps) // 2, axis=0), modulation)
        # A custom network may take no garments.
        known = () if modulation is None else (modulation,)
        out = network(maps, tuple(templates), *known)
        return {
            t: jnp.where(
                self.texel_points.valid[t][None, :, None],
                self._texel_values(m, t).astype(features.dtype) * self.normalisation.offset[t],
                0.0,
            )
            for t, m in out.items()
        }

    def _texel_values(
        self, maps: Float[Array, "all height width 3"], template: str
    ) -> Float[Array, "batch texels 3"]:
        """Texel values from maps; with test-time augmentation, the mean of both predictions."""
        if not self.mirror_tta:
            return _clip_length(self.atlas.from_map(maps))
        plain, twin = jnp.split(maps, 2)
        plain, twin = (_clip_length(self.atlas.from_map(m)) for m in (plain, _mirror_maps(twin)))
        # Where the mirrored texel isn't covered, the plain prediction is used alone.
        covered = self.texel_points.valid[template].astype(plain.dtype)[:, None]
        share = 0.5 * self.atlas.from_map(self.atlas.to_map(covered)[:, ::-1])[None]
        return plain + share * (twin - plain)


@bounded_jit(static_argnames=("graph", "template"), keep=4)
def _modulation(
    graph: Any, template: str, state: Any, maps: Float[Array, "batch height width channels"]
) -> Modulation:
    return nnx.merge(graph, state).modulation(template, maps)


def _mirror_maps(
    maps: Float[Array, "batch height width channels"],
) -> Float[Array, "batch height width channels"]:
    """Mirrors maps of vectors left to right: the halves of the chart are mirror images.

    Holds for vectors in world axes and for vectors in a texel's own frame.
    """
    channels = maps.shape[-1]
    signs = jnp.asarray(np.where(np.arange(channels) % 3 == 0, -1.0, 1.0), maps.dtype)
    return maps[:, :, ::-1] * signs[None, None, None]


def with_mirror_tta(predictor: Predictor) -> Predictor:
    """Adds test-time augmentation: averages with the prediction for the mirrored pose.

    This doubles the network's cost per frame. Predictions are then equivariant to mirroring,
    except where the halves of the chart aren't mirror images to the texel (garments differ
    by a quarter of a millimetre, single vertices by two).

    Args:
        predictor: A predictor on the built-in body's chart, whose halves are mirror images.

    Raises:
        ValueError: The halves of the atlas aren't mirror images.
    """
    atlas = predictor.motion_atlas
    positions = np.asarray(atlas.to_map(predictor.texel_points.rest))
    twins = positions[:, ::-1] * np.array([-1.0, 1.0, 1.0])
    mask = np.asarray(atlas.mask)
    both = mask & mask[:, ::-1]
    distance = np.linalg.norm(positions - twins, axis=-1)[both]
    if both.sum() < 0.99 * mask.sum() or np.quantile(distance, 0.99) > _MIRROR_TOLERANCE:
        raise ValueError("the halves of the atlas aren't mirror images; use the plain predictor.")
    return dataclasses.replace(predictor, mirror_tta=True)


def normalise(
    features: Float[Array, "*batch texels channels"],
    normalisation: Normalisation,
    inputs: FeatureConfig,
) -> Float[Array, "*batch texels channels"]:
    """Scales features to about [-1, 1], each kind separately (PhysXNet, section 5.1).

    Vectors are shortened to the largest plausible length: a teleport is treated as very
    fast motion instead of an input far outside the training range. Finite features stay finite,
    and so do gradients.
    """
    one = jnp.ones((), features.dtype)
    scales = {"velocity": normalisation.velocity, "acceleration": normalisation.acceleration}
    out, start = [], 0
    for kind in inputs.kinds:
        values = features[..., start : start + inputs.width(kind)] / scales.get(kind, one)
        out.append(_clip_length(values))
        start += inputs.width(kind)
    return jnp.concatenate(out, axis=-1)


def _clip_length(values: Float[Array, "*batch channels"]) -> Float[Array, "*batch channels"]:
    vectors = values.reshape(*values.shape[:-1], -1, 3)
    # Scaled first: the square of a huge number must not overflow. The scale cancels, so its
    # gradient isn't needed; that of a maximum is 0/0 where the compiler rounds values differently.
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
        finer=config.finer,
        conditions=len(CONDITIONS) if config.conditions else 0,
        skirt=config.skirt_chart,
        rngs=nnx.Rngs(seed),
    )
