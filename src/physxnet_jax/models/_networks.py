"""The generator (one encoder, one decoder per template) and the PatchGAN discriminator."""

import itertools
from collections.abc import Sequence

import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float

from ._blocks import Down, Up

LEVELS = 4


class Decoder(nnx.Module):
    """Four upsampling layers with skip connections from the encoder, ending in an offset map."""

    def __init__(self, width: int, *, rngs: nnx.Rngs) -> None:
        deep = [width * 2**k for k in range(LEVELS)]
        self.layers = nnx.List(
            [
                Up(deep[3], deep[2], rngs=rngs),
                Up(2 * deep[2], deep[1], rngs=rngs),
                Up(2 * deep[1], deep[0], rngs=rngs),
                Up(2 * deep[0], 3, norm=False, rngs=rngs),
            ]
        )

    def __call__(
        self, features: Sequence[Float[Array, "batch _h _w _c"]]
    ) -> Float[Array, "batch height width 3"]:
        """A map of normalised offsets from the encoder's features, finest first."""
        x = features[-1]
        for k, layer in enumerate(self.layers):
            x = layer(x)
            if k < LEVELS - 1:
                x = jnp.where(x > 0, x, 0.0)
                x = jnp.concatenate([x, features[LEVELS - 2 - k]], axis=-1)
        return x


class Generator(nnx.Module):
    """G, from maps of body motion to maps of garment offsets.

    Only the requested decoders are computed.

    Args:
        channels: Input channels (18 for `paper`, 24 for `local`).
        templates: Templates that get a decoder.
        width: Channels of the first layer; doubled at each of four levels.
        rngs: Random streams for the initial parameters.

    Example:
        >>> g = Generator(18, ("top",), width=4, rngs=nnx.Rngs(0))
        >>> g(jnp.zeros((1, 32, 32, 18)), ("top",))["top"].shape
        (1, 32, 32, 3)

    References:
        PhysXNet, section 3.2; Ronneberger et al., U-Net (2015).
    """

    def __init__(
        self, channels: int, templates: Sequence[str], *, width: int = 32, rngs: nnx.Rngs
    ) -> None:
        sizes = [channels, *(width * 2**k for k in range(LEVELS))]
        self.encoder = nnx.List([Down(a, b, rngs=rngs) for a, b in itertools.pairwise(sizes)])
        self.decoders = nnx.Dict({t: Decoder(width, rngs=rngs) for t in templates})

    def __call__(
        self,
        x: Float[Array, "batch height width channels"],
        templates: Sequence[str],
    ) -> dict[str, Float[Array, "batch height width 3"]]:
        """Normalised offset maps of the requested templates.

        Raises:
            ValueError: A size that isn't a multiple of 16.
        """
        if x.shape[1] % 2**LEVELS or x.shape[2] % 2**LEVELS:
            raise ValueError(
                f"maps of {x.shape[1]} x {x.shape[2]}: both must be multiples of"
                f" {2**LEVELS}, because there are {LEVELS} halvings."
            )
        features = []
        for layer in self.encoder:
            x = layer(x)
            features.append(x)
        return {t: self.decoders[t](features) for t in templates}


class Discriminator(nnx.Module):
    """D, a PatchGAN that classifies offset maps given the motion maps.

    Returns logits, one for each patch of 46 texels (the receptive field of three strided
    layers and the head).

    References:
        Isola et al., pix2pix (2017), section 3.2.2.
    """

    def __init__(self, channels: int, *, width: int = 32, rngs: nnx.Rngs) -> None:
        self.layers = nnx.List(
            [
                Down(channels, width, norm=False, slope=0.2, rngs=rngs),
                Down(width, 2 * width, slope=0.2, rngs=rngs),
                Down(2 * width, 4 * width, slope=0.2, rngs=rngs),
            ]
        )
        self.head = nnx.Conv(4 * width, 1, (4, 4), padding="SAME", rngs=rngs)

    def __call__(
        self,
        condition: Float[Array, "batch height width channels"],
        maps: Float[Array, "batch height width offsets"],
    ) -> Float[Array, "batch h w 1"]:
        """Logits of being real, one per patch."""
        x = jnp.concatenate([condition, maps], axis=-1)
        for layer in self.layers:
            x = layer(x)
        return self.head(x)
