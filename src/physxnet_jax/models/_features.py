"""Motion as the network sees it: texel velocities and accelerations of some frames."""

import dataclasses
from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..body import blend_rotations
from ..geometry import polar_rotation
from ..uv import acceleration_maps, velocity_maps

Family = Literal["paper", "local"]

_EXACT = jax.lax.Precision.HIGHEST


@dataclasses.dataclass(frozen=True)
class Inputs:
    """Which maps of the body's motion a network sees.

    Attributes:
        family: ``paper``: in the world's frame; ``local``: in each texel's own frame,
            the rotation nearest to its skinning.
        frames: Frames k - (frames - 1) stride, ..., k - stride, k are seen.
        stride: Frames from one to the next.
        acceleration: Accelerations beside velocities.
        gravity: The direction of gravity (``local`` only: elsewhere it is constant).
        place: Where the texel lies from the middle of the body (``local`` only): from
            it the pose can be told, of which velocities know nothing.
    """

    family: Family = "local"
    frames: int = 3
    stride: int = 1
    acceleration: bool = True
    gravity: bool = True
    place: bool = True

    def __post_init__(self) -> None:
        if self.frames < 1 or self.stride < 1:
            raise ValueError(f"{self}: frames and stride must be at least 1.")

    @property
    def window(self) -> int:
        """Poses needed for one answer; an acceleration reaches two frames back."""
        return (self.frames - 1) * self.stride + 3

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kinds of channels in their order, three or three times ``frames`` each."""
        local = self.family == "local"
        return (
            "velocity",
            *(["acceleration"] if self.acceleration else []),
            *(["gravity"] if self.gravity and local else []),
            *(["place"] if self.place and local else []),
        )

    @property
    def channels(self) -> int:
        """Channels in all: 18 for the paper's."""
        return sum(self.width(kind) for kind in self.kinds)

    def width(self, kind: str) -> int:
        """Channels of a kind."""
        return 3 * self.frames if kind in ("velocity", "acceleration") else 3


PAPER = Inputs("paper")
"""The paper's: velocities and accelerations of three frames in the world's frame."""


def skin_points(
    rest: Float[Array, "points 3"],
    weights: Float[Array, "points joints"],
    rotations: Float[Array, "joints 3 3"],
    translations: Float[Array, "joints 3"],
) -> tuple[Float[Array, "points 3"], Float[Array, "points 3 3"]]:
    """Skinned points [m] and the linear part of their skinning."""
    blend = blend_rotations(weights, rotations)
    shift = jnp.matmul(weights, translations, precision=_EXACT)
    return jnp.einsum("pab,pb->pa", blend, rest, precision=_EXACT) + shift, blend


def clip_features(
    rest: Float[Array, "texels 3"],
    weights: Float[Array, "texels joints"],
    rotations: Float[Array, "padded joints 3 3"],
    translations: Float[Array, "padded joints 3"],
    fps: float,
    inputs: Inputs,
) -> Float[Array, "frames texels channels"]:
    """Features of successive frames, each point skinned once.

    Turning the person about the vertical axis leaves ``local`` features as they are.

    Args:
        rest: Texel points at rest [m].
        weights: Their skinning weights.
        rotations: World rotations of joints of all frames, with ``inputs.window - 1``
            frames before the first one wanted; repeat the first frame there at a
            clip's start.
        translations: World translations of joints [m], likewise.
        fps: Frames a second.
        inputs: Which features.

    Returns:
        Features of every covered texel: velocities [m/s], oldest first, accelerations
        [m/s^2], gravity's direction, place [m].

    References:
        PhysXNet, section 3.1: X = (I_v, I_a) of frames k-2 to k.
    """
    points, blends = jax.vmap(skin_points, in_axes=(None, None, 0, 0))(
        rest, weights, rotations, translations
    )
    return point_features(points, blends[inputs.window - 1 :], fps, inputs)


def point_features(
    points: Float[Array, "padded texels 3"],
    blends: Float[Array, "frames texels 3 3"],
    fps: float,
    inputs: Inputs,
) -> Float[Array, "frames texels channels"]:
    """`clip_features` of points that are skinned already.

    Args:
        points: Skinned texel points [m], ``inputs.window - 1`` frames more than wanted.
        blends: Linear parts of the skinning of the frames wanted.
        fps: Frames a second.
        inputs: Which features.
    """
    lead = inputs.window - 1
    frames, texels = blends.shape[:2]
    back = [lead - inputs.stride * k for k in range(inputs.frames - 1, -1, -1)]
    moved = [velocity_maps(points, fps)]
    if inputs.acceleration:
        moved.append(acceleration_maps(points, fps))
    both = jnp.stack([x[k : k + frames] for x in moved for k in back], axis=2)
    if inputs.family == "paper":
        return both.reshape(frames, texels, -1)
    frame = polar_rotation(blends)
    turned = jnp.einsum("fpba,fpkb->fpka", frame, both, precision=_EXACT)
    out = [turned.reshape(frames, texels, -1)]
    if inputs.gravity:
        out.append(-frame[:, :, 1, :])
    if inputs.place:
        away = points[lead:] - jnp.mean(points[lead:], axis=1, keepdims=True)
        out.append(jnp.einsum("fpba,fpb->fpa", frame, away, precision=_EXACT))
    return jnp.concatenate(out, axis=2)
