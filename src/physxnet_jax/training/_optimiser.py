"""What a network learns by: Adam, or Muon for the kernels of its convolutions."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float

from ._config import TrainConfig

_BETA = 0.95
# Coefficients and count of Newton-Schulz steps, as published with Muon.
_NEWTON_SCHULZ, _ROUNDS = (3.4445, -4.7750, 2.0315), 5


def make_optimiser(
    config: TrainConfig, rate: float, steps: int, *, kernel_rate: float | None = None
) -> optax.GradientTransformation:
    """Adam as in the paper, or Muon; updates that aren't finite are skipped and counted.

    Args:
        config: The run.
        rate: Adam's rate.
        steps: Length of the run.
        kernel_rate: Muon's rate, if kernels of convolutions learn by it.
    """

    def schedule(peak: float) -> optax.Schedule:
        if config.schedule == "constant":
            return optax.constant_schedule(peak)
        warm = max(steps // 50, 1)
        # From zero the first step would change nothing.
        return optax.warmup_cosine_decay_schedule(peak / warm, peak, warm, max(steps, 2))

    inner = optax.adam(schedule(rate), b1=config.momentum)
    if kernel_rate is not None:
        muon = optax.chain(
            scale_by_orthogonal_momentum(), optax.scale_by_learning_rate(schedule(kernel_rate))
        )
        inner = optax.partition(
            {"muon": muon, "adam": inner}, lambda params: jax.tree.map(_learns_by, params)
        )
    # The loop gives up after max_skipped; the optimiser itself must never let one in.
    return optax.apply_if_finite(inner, 2**31 - 2)


def _learns_by(parameter: Array) -> str:
    # The last layer's three channels are metres: no features to keep apart.
    return "muon" if parameter.ndim == 4 and parameter.shape[-1] > 3 else "adam"


class OrthogonalMomentum(NamedTuple):
    """State of `scale_by_orthogonal_momentum`: the mean of gradients."""

    mean: optax.Updates


def scale_by_orthogonal_momentum() -> optax.GradientTransformation:
    """Momentum (Nesterov's) whose matrix has all its singular values near one.

    Kernels [height, width, inputs, outputs] are matrices from all they see to their
    outputs. ``optax.contrib.muon`` does the same, but iterates on the whole matrix: ten
    products of it in place of two, and small ones of its Gram matrix.

    References:
        Jordan et al., Muon: an optimizer for hidden layers in neural networks (2024).
    """

    def init(params: optax.Params) -> OrthogonalMomentum:
        return OrthogonalMomentum(jax.tree.map(jnp.zeros_like, params))

    def update(
        updates: optax.Updates, state: OrthogonalMomentum, params: optax.Params | None = None
    ) -> tuple[optax.Updates, OrthogonalMomentum]:
        del params
        mean = jax.tree.map(lambda m, g: _BETA * m + (1 - _BETA) * g, state.mean, updates)
        ahead = jax.tree.map(lambda m, g: _BETA * m + (1 - _BETA) * g, mean, updates)
        return jax.tree.map(_orthogonal_kernel, ahead), OrthogonalMomentum(mean)

    return optax.GradientTransformation(init, update)  # pyright: ignore[reportArgumentType]


def _orthogonal_kernel(kernel: Float[Array, "*seen outputs"]) -> Float[Array, "*seen outputs"]:
    matrix = kernel.reshape(-1, kernel.shape[-1])
    rows, columns = matrix.shape
    out = orthogonalise(matrix.T).T if rows < columns else orthogonalise(matrix)
    return max(1.0, columns / rows) ** 0.5 * out.reshape(kernel.shape)


def orthogonalise(matrix: Float[Array, "rows columns"]) -> Float[Array, "rows columns"]:
    """The matrix with singular values brought near one (0.6 to 1.25), its directions kept.

    Newton-Schulz steps X <- X (a + b X'X + c (X'X)^2) commute with X'X, so that their
    product is found among matrices of columns x columns alone. Singular values below
    about 1/500 of the norm stay smaller. A zero matrix stays zero.

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
    for _ in range(_ROUNDS):
        step = a * eye + b * gram + c * (gram @ gram)
        product, gram = product @ step, gram @ (step @ step)
    return scaled @ (product / jnp.sqrt(norm))
