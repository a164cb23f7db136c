"""Optimizers: Adam, or Muon for convolution kernels."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float

from ._config import TrainConfig

_BETA = 0.95
# Coefficients and count of Newton-Schulz steps, as published with Muon.
_NEWTON_SCHULZ, _NEWTON_SCHULZ_STEPS = (3.4445, -4.7750, 2.0315), 5


def make_optimizer(
    config: TrainConfig, rate: float, steps: int, *, muon_learning_rate: float | None = None
) -> optax.GradientTransformation:
    """Adam as in the paper, or Muon; non-finite updates are skipped and counted.

    Args:
        config: Settings of the run.
        rate: Adam's learning rate.
        steps: Length of the run in steps.
        muon_learning_rate: Muon's learning rate for convolution kernels; None for Adam alone.
    """

    def schedule(peak: float) -> optax.Schedule:
        if config.schedule == "constant":
            return optax.constant_schedule(peak)
        warm = max(steps // 50, 1)
        # Not from zero, where the first step would change nothing.
        return optax.warmup_cosine_decay_schedule(peak / warm, peak, warm, max(steps, 2))

    inner = optax.adam(schedule(rate), b1=config.b1)
    if muon_learning_rate is not None:
        muon = optax.chain(
            scale_by_muon(), optax.scale_by_learning_rate(schedule(muon_learning_rate))
        )
        inner = optax.partition(
            {"muon": muon, "adam": inner}, lambda params: jax.tree.map(_optimizer_of, params)
        )
    # The loop aborts after max_skipped; the optimizer must never apply a non-finite update.
    return optax.apply_if_finite(inner, 2**31 - 2)


def _optimizer_of(parameter: Array) -> str:
    # The last layer's three channels are offsets in metres, not features to orthogonalise.
    return "muon" if parameter.ndim == 4 and parameter.shape[-1] > 3 else "adam"


class MuonState(NamedTuple):
    """State of `scale_by_muon`: the moving average of gradients."""

    mean: optax.Updates


def scale_by_muon() -> optax.GradientTransformation:
    """Nesterov momentum, orthogonalised: all singular values of its matrix are near one.

    Kernels [height, width, inputs, outputs] are matrices from their receptive field to their
    outputs. ``optax.contrib.muon`` does the same but iterates on the whole matrix: it takes ten
    products of that matrix instead of two and small products of its Gram matrix.

    References:
        Jordan et al., Muon: an optimizer for hidden layers in neural networks (2024).
    """

    def init(params: optax.Params) -> MuonState:
        return MuonState(jax.tree.map(jnp.zeros_like, params))

    def update(
        updates: optax.Updates, state: MuonState, params: optax.Params | None = None
    ) -> tuple[optax.Updates, MuonState]:
        del params
        mean = jax.tree.map(lambda m, g: _BETA * m + (1 - _BETA) * g, state.mean, updates)
        nesterov = jax.tree.map(lambda m, g: _BETA * m + (1 - _BETA) * g, mean, updates)
        return jax.tree.map(_orthogonal_kernel, nesterov), MuonState(mean)

    return optax.GradientTransformation(init, update)  # pyright: ignore[reportArgumentType]


def _orthogonal_kernel(kernel: Float[Array, "*seen outputs"]) -> Float[Array, "*seen outputs"]:
    matrix = kernel.reshape(-1, kernel.shape[-1])
    rows, columns = matrix.shape
    out = (
        orthogonalize_via_newton_schulz(matrix.T).T
        if rows < columns
        else orthogonalize_via_newton_schulz(matrix)
    )
    return max(1.0, columns / rows) ** 0.5 * out.reshape(kernel.shape)


def orthogonalize_via_newton_schulz(
    matrix: Float[Array, "rows columns"],
) -> Float[Array, "rows columns"]:
    """Brings the singular values of a matrix near one (0.6 to 1.25); keeps its singular vectors.

    Newton-Schulz steps X <- X (a + b X'X + c (X'X)^2) commute with X'X, so their product is
    computed from matrices of columns x columns alone. Singular values below about 1/500 of
    the norm stay smaller. A zero matrix stays zero.

    Args:
        matrix: No more columns than rows.
    """
    a, b, c = _NEWTON_SCHULZ
    # Scaled first: squares of tiny gradients must not underflow.
    largest = jnp.max(jnp.abs(matrix))
    scaled = matrix / jnp.where(largest > 0, largest, 1.0)
    gram = scaled.T @ scaled
    norm = jnp.maximum(jnp.trace(gram), 1e-12)
    gram = gram / norm
    eye = jnp.eye(len(gram), dtype=matrix.dtype)
    product = eye
    for _ in range(_NEWTON_SCHULZ_STEPS):
        step = a * eye + b * gram + c * (gram @ gram)
        product, gram = product @ step, gram @ (step @ step)
    return scaled @ (product / jnp.sqrt(norm))
