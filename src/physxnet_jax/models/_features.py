"""Motion features of a network: texel velocities and accelerations of several frames."""

import dataclasses
from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..body import skin_points
from ..geometry import polar_rotation
from ..uv import acceleration_maps, velocity_maps

Family = Literal["paper", "local"]

# Frames per second at which networks learn.
_RATE = 30.0


@dataclasses.dataclass(frozen=True)
class FeatureConfig:
    """Which maps of the body's motion are a network's inputs.

    Attributes:
        family: ``paper``: in the world frame; ``local``: in each texel's own frame, the
            rotation nearest to its skinning.
        frames: Number of input frames: k - (frames - 1) stride, ..., k - stride, k.
        stride: Frames from one input frame to the next.
        span: Frames over which velocities and accelerations are taken.
        acceleration: Include accelerations besides velocities.
        gravity: Include the direction of gravity (``local`` only: elsewhere it is constant).
        position: Include the texel's position relative to the middle of the body (``local``
            only): it encodes the pose, which velocities don't.
    """

    family: Family = "local"
    frames: int = 3
    stride: int = 1
    span: int = 1
    acceleration: bool = True
    gravity: bool = True
    position: bool = True

    def __post_init__(self) -> None:
        if self.frames < 1 or self.stride < 1 or self.span < 1:
            raise ValueError(f"{self}: frames, stride and span must be at least 1.")

    def at_rate(self, fps: float) -> "FeatureConfig":
        """These features, which are of 30 frames per second, at another rate.

        They are of the same moments, to the nearest frame: at 60 and 120 frames per second exactly
        the same.

        Args:
            fps: Frames per second of the motion.

        >>> FeatureConfig(frames=4, stride=4).at_rate(60.0).window
        29
        """
        stride, span = (max(1, round(n * fps / _RATE)) for n in (self.stride, self.span))
        return dataclasses.replace(self, stride=stride, span=span)

    @property
    def window(self) -> int:
        """Poses needed for one prediction; an acceleration reaches two spans back."""
        return (self.frames - 1) * self.stride + 2 * self.span + 1

    @property
    def seen(self) -> tuple[int, ...]:
        """How many frames back the poses lie that one prediction sees, itself included."""
        first = [self.stride * k for k in range(self.frames)]
        return tuple(sorted({k + self.span * n for k in first for n in range(3)}))

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kinds of channels in order; each has three or three times ``frames`` channels."""
        local = self.family == "local"
        return (
            "velocity",
            *(["acceleration"] if self.acceleration else []),
            *(["gravity"] if self.gravity and local else []),
            *(["position"] if self.position and local else []),
        )

    @property
    def channels(self) -> int:
        """Total number of channels; 18 for the paper's features."""
        return sum(self.width(kind) for kind in self.kinds)

    def width(self, kind: str) -> int:
        """Number of channels of a kind."""
        return 3 * self.frames if kind in ("velocity", "acceleration") else 3


PAPER = FeatureConfig("paper")
"""The paper's features: velocities and accelerations of three frames in the world frame."""


def clip_features(
    rest: Float[Array, "texels 3"],
    weights: Float[Array, "texels joints"],
    rotations: Float[Array, "padded joints 3 3"],
    translations: Float[Array, "padded joints 3"],
    fps: float,
    inputs: FeatureConfig,
) -> Float[Array, "frames texels channels"]:
    """Features of successive frames; each point is skinned once per frame.

    ``local`` features are invariant to rotation of the person about the vertical axis.

    Args:
        rest: Texel points at rest [m].
        weights: Their skinning weights.
        rotations: World rotations of joints of all frames, with ``window - 1`` frames of
            ``inputs.at_rate(fps)`` before the first output frame. At the start of a clip, repeat
            its first frame there.
        translations: World translations of joints [m], likewise.
        fps: Frames per second.
        inputs: Which features to compute, at 30 frames per second.

    Returns:
        Features of every covered texel: velocities [m/s], oldest first, accelerations
        [m/s^2], direction of gravity, position [m].

    References:
        PhysXNet, section 3.1: X = (I_v, I_a) of frames k-2 to k.
    """
    points, blends = jax.vmap(skin_points, in_axes=(None, None, 0, 0))(
        rest, weights, rotations, translations
    )
    return point_features(points, blends[inputs.at_rate(fps).window - 1 :], fps, inputs)


def point_features(
    points: Float[Array, "padded texels 3"],
    blends: Float[Array, "frames texels 3 3"],
    fps: float,
    inputs: FeatureConfig,
) -> Float[Array, "frames texels channels"]:
    """`clip_features` from points that are already skinned.

    Args:
        points: Skinned texel points [m], with ``window - 1`` frames of ``inputs.at_rate(fps)``
            before the first output frame.
        blends: Linear parts of the skinning in the output frames.
        fps: Frames per second.
        inputs: Which features to compute, at 30 frames per second.
    """
    inputs = inputs.at_rate(fps)
    lead = inputs.window - 1
    frames, texels = blends.shape[:2]
    back = [lead - inputs.stride * k for k in range(inputs.frames - 1, -1, -1)]
    moved = [velocity_maps(points, fps, inputs.span)]
    if inputs.acceleration:
        moved.append(acceleration_maps(points, fps, inputs.span))
    both = jnp.stack([x[k : k + frames] for x in moved for k in back], axis=2)
    if inputs.family == "paper":
        return both.reshape(frames, texels, -1)
    frame = polar_rotation(blends)
    # Sums of products: several times as fast as products of small matrices.
    turned = jnp.sum(frame[:, :, None] * both[..., None], axis=3)
    out = [turned.reshape(frames, texels, -1)]
    if inputs.gravity:
        out.append(-frame[:, :, 1, :])
    if inputs.position:
        away = points[lead:] - jnp.mean(points[lead:], axis=1, keepdims=True)
        out.append(jnp.sum(frame * away[..., None], axis=2))
    return jnp.concatenate(out, axis=2)
