"""Networks for inference: batch norm folded into the convolutions, selectable precision."""

import dataclasses
from typing import Any, Literal

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float

from .._programs import bounded_jit
from ._blocks import Down, Up, upsample, upsampling_kernel
from ._networks import Generator
from ._predictor import Predictor


class _Convolution(nnx.Module):
    """A convolution to half or twice the resolution, with bias and activation."""

    def __init__(self, kernel: Array, bias: Array, *, slope: float | None, up: bool) -> None:
        self.kernel, self.bias = nnx.Param(kernel), nnx.Param(bias)
        self.slope, self.up = slope, up

    def __call__(
        self, x: Float[Array, "batch height width channels"]
    ) -> Float[Array, "batch h w outputs"]:
        """Features at half or twice the resolution."""
        kernel = self.kernel[...].astype(x.dtype)
        if self.up:
            x = upsample(x, kernel)
        else:
            x = jax.lax.conv_general_dilated(
                x, kernel, (2, 2), ((1, 1), (1, 1)), dimension_numbers=("NHWC", "HWIO", "NHWC")
            )
        x = x + self.bias[...].astype(x.dtype)[None, None, None]
        return x if self.slope is None else jnp.where(x > 0, x, self.slope * x)


def fold_batch_norm(predictor: Predictor) -> Predictor:
    """Folds the batch norm of a predictor's network into its convolutions.

    A network that is already folded is left unchanged.

    The statistics are fixed outside training, so each norm is a scale and a shift of its
    convolution's output. Upsampling kernels are converted to the form in which they are used.
    The result can be differentiated but isn't meant to be trained or saved.

    Args:
        predictor: A predictor. Only a `Generator` is folded; any other module passes through.

    Returns:
        The folded predictor; predictions differ by rounding alone.
    """
    network = nnx.merge(predictor.graph, predictor.state, copy=True)
    _fold(network)
    graph, state = nnx.split(network)
    return dataclasses.replace(predictor, graph=graph, state=state)


def _fold(network: Any) -> None:
    # A custom network is used as it is.
    if not isinstance(network, Generator):
        return
    parts: Any = network
    for k, layer in enumerate(parts.encoder):
        parts.encoder[k] = _down(layer) if isinstance(layer, Down) else layer
    for decoder in parts.decoders.values():
        for k, layer in enumerate(decoder.layers):
            decoder.layers[k] = _up(layer) if isinstance(layer, Up) else layer


def at_precision(
    predictor: Predictor, precision: Literal["float32", "bfloat16", "float64"]
) -> Predictor:
    """A folded predictor that computes its network in another precision.

    Features and the postprocessing of maps are unchanged.

    Args:
        predictor: A predictor.
        precision: Type of parameters and arithmetic. ``float64`` needs ``jax_enable_x64``.

    Returns:
        The predictor; batch norm is folded before rounding.
    """
    folded = fold_batch_norm(predictor)
    dtype = jnp.dtype(precision)
    state = jax.tree.map(lambda x: x.astype(dtype), folded.state)
    return dataclasses.replace(folded, state=state)


def _down(layer: Down) -> _Convolution:
    kernel, shift = _folded(layer.conv.kernel[...], _value(layer.conv.bias), *_plain(layer.norm))
    return _Convolution(kernel, shift, slope=layer.slope, up=False)


def _up(layer: Up) -> _Convolution:
    kernel, shift = _folded(layer.kernel[...], _value(layer.bias), *_plain(layer.norm), up=True)
    return _Convolution(kernel, shift, slope=None, up=True)


def _value(x: nnx.Variable | None) -> Array | None:
    return None if x is None else x[...]


def _plain(norm: nnx.BatchNorm | None) -> tuple[tuple[Array | None, ...], float]:
    """Variance, mean, scale and bias of a norm, and its epsilon."""
    if norm is None:
        return (None, None, None, None), 0.0
    return (norm.var[...], norm.mean[...], _value(norm.scale), _value(norm.bias)), norm.epsilon


@bounded_jit(static_argnames=("epsilon", "up"), keep=32)
def _folded(
    kernel: Float[Array, "h w inputs outputs"],
    bias: Float[Array, " outputs"] | None,
    norm: tuple[Array | None, ...],
    epsilon: float,
    up: bool = False,
) -> tuple[Float[Array, "2 2 inputs fourfold"] | Float[Array, "4 4 inputs c"], Float[Array, " c"]]:
    """Kernel and bias equivalent to a convolution and the norm after it."""
    shift = jnp.zeros(kernel.shape[-1:], kernel.dtype) if bias is None else bias
    var, mean, gain, offset = norm
    if var is not None and mean is not None:
        scale = jax.lax.rsqrt(var + epsilon)
        scale = scale if gain is None else scale * gain
        shift = (shift - mean) * scale
        shift = shift if offset is None else shift + offset
        kernel = kernel * scale[None, None, None]
    return (upsampling_kernel(kernel), shift) if up else (kernel, shift)
