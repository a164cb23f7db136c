"""Building blocks: strided convolutions down, transposed convolutions up."""

from typing import Any

import jax
import jax.numpy as jnp
from flax import nnx
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float

# PyTorch's 0.1 in Flax's convention; Flax's default of 0.99 adapts too slowly here.
_MOMENTUM = 0.9


def batch_norm(channels: int, rngs: nnx.Rngs) -> nnx.BatchNorm:
    """Batch norm with two-pass variance: the one-pass formula cancels at large means."""
    return nnx.BatchNorm(
        channels, momentum=_MOMENTUM, epsilon=1e-5, use_fast_variance=False, rngs=rngs
    )


class Down(nnx.Module):
    """4x4 convolution of stride 2, batch norm and activation; halves the resolution.

    References:
        PhysXNet, section 3.2, encoder layer; Isola et al., pix2pix (2017).
    """

    def __init__(
        self,
        inputs: int,
        outputs: int,
        *,
        norm: bool = True,
        slope: float = 0.0,
        rngs: nnx.Rngs,
    ) -> None:
        self.conv = nnx.Conv(
            inputs,
            outputs,
            (4, 4),
            strides=2,
            padding=((1, 1), (1, 1)),
            use_bias=not norm,
            rngs=rngs,
        )
        self.norm = batch_norm(outputs, rngs) if norm else None
        self.slope = slope

    def __call__(
        self, x: Float[Array, "batch height width channels"]
    ) -> Float[Array, "batch h w outputs"]:
        """Features at half the resolution."""
        x = self.conv(x)
        if self.norm is not None:
            x = self.norm(x)
        return jnp.where(x > 0, x, self.slope * x)


def upsampling_kernel(
    kernel: Float[Array, "4 4 inputs outputs"],
) -> Float[Array, "2 2 inputs fourfold"]:
    """The 2x2 kernel with which `upsample` computes a stride-2 transposed convolution.

    Output pixel (2i + p, 2j + q) of a 4x4 transposed convolution of stride 2 and
    padding 1 depends on 2x2 inputs around (i, j). The parity (p, q) selects the taps:
    along one axis, parity 0 reads inputs i-1, i with taps 3, 1; parity 1 reads inputs
    i, i+1 with taps 2, 0.

    Args:
        kernel: Taps of the transposed convolution.

    Returns:
        Kernel with output channels ordered (p, q, channel).
    """
    parts = [kernel[3 - p :: -2, 3 - q :: -2] for p in range(2) for q in range(2)]
    return jnp.concatenate(parts, axis=-1)


def upsample(
    x: Float[Array, "batch height width inputs"], kernel: Float[Array, "2 2 inputs fourfold"]
) -> Float[Array, "batch h w outputs"]:
    """4x4 transposed convolution of stride 2; doubles the resolution.

    Each 2x2 window of inputs is evaluated for all four parities, and each output pixel
    selects its own. Except at the border, no product is computed that isn't needed.

    Args:
        x: Features.
        kernel: From `upsampling_kernel`.
    """
    n, h, w, _ = x.shape
    windows = _windows(x, kernel).reshape(n, h + 1, w + 1, 2, 2, -1)
    rows = [
        jnp.stack([windows[:, p : p + h, q : q + w, p, q] for q in range(2)], axis=3)
        for p in range(2)
    ]
    return jnp.stack(rows, axis=2).reshape(n, 2 * h, 2 * w, -1)


@jax.custom_jvp
def _windows(x: Array, kernel: Array) -> Array:
    """Convolution of every 2x2 window of the padded features, including those at the border."""
    return jax.lax.conv_general_dilated(
        x, kernel, (1, 1), ((1, 1), (1, 1)), dimension_numbers=("NHWC", "HWIO", "NHWC")
    )


def _windows_jvp(primals: tuple[Array, Array], tangents: tuple[Any, Any]) -> tuple[Array, Any]:
    # XLA's own gradient for the kernel is many times slower on CPUs.
    (x, kernel), (dx, dkernel) = primals, tangents
    out = _windows(x, kernel)
    change = jnp.zeros_like(out)
    if not isinstance(dx, SymbolicZero):
        change = change + _windows(dx, kernel)
    if not isinstance(dkernel, SymbolicZero):
        h, w = x.shape[1] + 1, x.shape[2] + 1
        padded = jnp.pad(x, ((0, 0), (1, 1), (1, 1), (0, 0)))
        seen = [padded[:, a : a + h, b : b + w] for a in range(2) for b in range(2)]
        flat = dkernel.reshape(-1, dkernel.shape[3])
        change = change + jnp.matmul(jnp.concatenate(seen, axis=-1), flat)
    return out, change


_windows.defjvp(_windows_jvp, symbolic_zeros=True)


class Up(nnx.Module):
    """4x4 transposed convolution of stride 2 and batch norm; doubles the resolution.

    Computed by `upsample`: the same linear map as the textbook form, several times faster
    on CPUs.

    References:
        PhysXNet, section 3.2, decoder layer.
    """

    def __init__(self, inputs: int, outputs: int, *, norm: bool = True, rngs: nnx.Rngs) -> None:
        init = nnx.initializers.lecun_normal()
        # Factor 2, because each output pixel uses a quarter of the taps.
        kernel = 2.0 * init(rngs.params(), (4, 4, inputs, outputs), jnp.float32)
        self.kernel = nnx.Param(kernel)
        self.bias = None if norm else nnx.Param(jnp.zeros((outputs,), jnp.float32))
        self.norm = batch_norm(outputs, rngs) if norm else None

    def __call__(
        self, x: Float[Array, "batch height width channels"]
    ) -> Float[Array, "batch h w outputs"]:
        """Features at twice the resolution."""
        x = upsample(x, upsampling_kernel(self.kernel[...].astype(x.dtype)))
        if self.bias is not None:
            x = x + self.bias[...].astype(x.dtype)[None, None, None]
        return x if self.norm is None else self.norm(x)
