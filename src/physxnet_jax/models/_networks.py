"""The generator (one encoder, one decoder per template) and the PatchGAN discriminator."""

import itertools
from collections.abc import Mapping, Sequence

import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float

from ._blocks import Down, Up

LEVELS = 4


Modulation = tuple[tuple[Array, Array], ...]
"""Scale and shift of each hidden layer of a decoder, shapes [batch, h, w, channels]."""

_CONDITION_WIDTH = 16


class Modulator(nnx.Module):
    """From maps of a garment to the scales and shifts of a decoder's hidden layers.

    Args:
        conditions: Channels of the maps.
        widths: Channels of the hidden layers, coarsest first.
        rngs: Random streams for the initial parameters.

    References:
        Perez et al., FiLM (2018), with a scale and a shift of their own at every texel.
    """

    def __init__(self, conditions: int, widths: Sequence[int], *, rngs: nnx.Rngs) -> None:
        sizes = [conditions, *(_CONDITION_WIDTH for _ in widths)]
        self.layers = nnx.List(
            [Down(a, b, norm=False, slope=0.2, rngs=rngs) for a, b in itertools.pairwise(sizes)]
        )
        # At first every layer is left as it is.
        zeros = nnx.initializers.zeros_init()
        self.heads = nnx.List(
            [
                nnx.Conv(_CONDITION_WIDTH, 2 * w, (1, 1), kernel_init=zeros, rngs=rngs)
                for w in reversed(widths)
            ]
        )

    def __call__(self, conditions: Float[Array, "batch height width channels"]) -> Modulation:
        """Scales and shifts, coarsest first."""
        x, out = conditions, []
        for layer, head in zip(self.layers, self.heads, strict=True):
            x = layer(x)
            scale, shift = jnp.split(head(x), 2, axis=-1)
            out.append((scale, shift))
        return tuple(reversed(out))


class Decoder(nnx.Module):
    """Upsampling layers with skip connections from the encoder, ending in an offset map.

    Args:
        width: Channels of the encoder's first layer.
        finer: Whether the map has twice the resolution of the encoder's input.
        conditions: Channels of maps that describe the garment; 0 for none.
        rngs: Random streams for the initial parameters.
    """

    def __init__(
        self, width: int, *, finer: bool = False, conditions: int = 0, rngs: nnx.Rngs
    ) -> None:
        deep = [width * 2**k for k in range(LEVELS)]
        widths = [deep[2], deep[1], deep[0], *([max(width // 2, 4)] if finer else [])]
        inputs = [deep[3], 2 * deep[2], 2 * deep[1], 2 * deep[0], *(widths[3:])]
        self.layers = nnx.List(
            [Up(a, b, norm=b != 3, rngs=rngs) for a, b in zip(inputs, [*widths, 3], strict=True)]
        )
        self.modulator = Modulator(conditions, widths, rngs=rngs) if conditions else None

    def __call__(
        self,
        features: Sequence[Float[Array, "batch _h _w _c"]],
        modulation: Modulation | None = None,
    ) -> Float[Array, "batch height width 3"]:
        """A map of normalised offsets from the encoder's features, finest first."""
        x = features[-1]
        for k, layer in enumerate(self.layers):
            x = layer(x)
            if k == len(self.layers) - 1:
                break
            if modulation is not None:
                scale, shift = modulation[k]
                x = x + (x * scale.astype(x.dtype) + shift.astype(x.dtype))
            # What isn't finite stays so: cloth mustn't pass for good where motion was lost.
            x = jnp.where(x <= 0, 0.0, x)
            if k < LEVELS - 1:
                x = jnp.concatenate([x, features[LEVELS - 2 - k]], axis=-1)
        return x


class Generator(nnx.Module):
    """G, from maps of body motion to maps of garment offsets.

    Only the requested decoders are computed. What depends on a garment alone, its `modulation`,
    enters the decoders and is computed once.

    Args:
        channels: Input channels (18 for `paper`, 24 for `local`).
        templates: Templates that get a decoder.
        width: Channels of the first layer; doubled at each of four levels.
        finer: Whether offset maps have twice the resolution of motion maps.
        conditions: Channels of maps that describe a garment; 0 for none.
        skirt: Whether the lowest third of the maps is the chart of skirts: all decoders but that
            of ``dress`` leave it out.
        rngs: Random streams for the initial parameters.

    Example:
        >>> g = Generator(18, ("top",), width=4, rngs=nnx.Rngs(0))
        >>> g(jnp.zeros((1, 32, 32, 18)), ("top",))["top"].shape
        (1, 32, 32, 3)

    References:
        PhysXNet, section 3.2; Ronneberger et al., U-Net (2015).
    """

    def __init__(
        self,
        channels: int,
        templates: Sequence[str],
        *,
        width: int = 32,
        finer: bool = False,
        conditions: int = 0,
        skirt: bool = False,
        rngs: nnx.Rngs,
    ) -> None:
        self.skirt = skirt
        sizes = [channels, *(width * 2**k for k in range(LEVELS))]
        self.encoder = nnx.List([Down(a, b, rngs=rngs) for a, b in itertools.pairwise(sizes)])
        self.decoders = nnx.Dict(
            {t: Decoder(width, finer=finer, conditions=conditions, rngs=rngs) for t in templates}
        )

    def modulation(
        self, template: str, conditions: Float[Array, "batch height width channels"]
    ) -> Modulation:
        """What a garment's maps change in the decoder of its template."""
        modulator = self.decoders[template].modulator
        if modulator is None:
            raise ValueError("this network takes no maps of garments.")
        return modulator(self._used(template, conditions))

    def _used(
        self, template: str, maps: Float[Array, "batch height width channels"]
    ) -> Float[Array, "batch h width channels"]:
        """The rows of maps that a template's decoder needs."""
        whole = template == "dress" or not self.skirt
        return maps if whole else maps[:, : maps.shape[1] * 2 // 3]

    def __call__(
        self,
        x: Float[Array, "batch height width channels"],
        templates: Sequence[str],
        modulation: Mapping[str, Modulation] | None = None,
    ) -> dict[str, Float[Array, "batch h w 3"]]:
        """Normalised offset maps of the requested templates.

        Args:
            x: Maps of motion.
            templates: Templates whose maps to compute.
            modulation: Of the garment of each template, see `modulation`; only for a network with
                conditions.

        Raises:
            ValueError: A size that isn't a multiple of 16, or of 48 with the chart of skirts.
        """
        features = self.encode(x)
        known = modulation or {}
        return {t: self.decode(t, features, known.get(t)) for t in templates}

    def encode(
        self, x: Float[Array, "batch height width channels"]
    ) -> list[Float[Array, "batch _h _w _c"]]:
        """Features of maps of motion, finest first."""
        rows = 3 * 2**LEVELS if self.skirt else 2**LEVELS
        if x.shape[1] % rows or x.shape[2] % 2**LEVELS:
            raise ValueError(
                f"maps of {x.shape[1]} x {x.shape[2]}: both must be multiples of"
                f" {2**LEVELS}, because there are {LEVELS} halvings"
                + (", and rows of three times that." if self.skirt else ".")
            )
        features = []
        for layer in self.encoder:
            x = layer(x)
            features.append(x)
        return features

    def decode(
        self,
        template: str,
        features: Sequence[Float[Array, "batch _h _w _c"]],
        modulation: Modulation | None = None,
    ) -> Float[Array, "batch h w 3"]:
        """A template's map of normalised offsets, from what `encode` gave."""
        seen = [self._used(template, f) for f in features]
        m = self.decoders[template](seen, modulation)
        # Rows of the chart that was left out.
        missing = m.shape[1] * features[0].shape[1] // seen[0].shape[1] - m.shape[1]
        return jnp.pad(m, ((0, 0), (0, missing), (0, 0), (0, 0))) if missing else m


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
