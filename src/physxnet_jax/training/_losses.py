"""The paper's losses: adversarial cross entropy with noisy labels, and L1 or L2 on texels."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, Key


def soft_labels(
    key: Key[Array, ""], shape: tuple[int, ...], *, real: bool, flip: float = 0.05
) -> Float[Array, "..."]:
    """Noisy labels: generated in U(0, 0.3), real in U(0.7, 1), a few swapped.

    Args:
        key: Random key.
        shape: One label per patch.
        real: Whether the maps are real.
        flip: Share of labels that get a value of the other class.

    Note (differs from the paper):
        Labels are swapped for single patches and anew in every step; the paper swaps the
        same share of frames for an epoch.

    References:
        PhysXNet, section 5.1.
    """
    k_value, k_flip = jax.random.split(key)
    low = jax.random.uniform(k_value, shape, jnp.float32, 0.0, 0.3)
    swapped = jax.random.bernoulli(k_flip, flip, shape)
    return jnp.where(swapped != real, 1.0 - low, low)


def discriminator_loss(
    real_logits: Float[Array, "*batch"],
    fake_logits: Float[Array, "*batch"],
    real_labels: Float[Array, "*batch"],
    fake_labels: Float[Array, "*batch"],
) -> Float[Array, ""]:
    """Sigmoid cross entropy of both classes (PhysXNet, equation 1)."""
    real = optax.sigmoid_binary_cross_entropy(real_logits, real_labels)
    fake = optax.sigmoid_binary_cross_entropy(fake_logits, fake_labels)
    return jnp.mean(real) + jnp.mean(fake)


def adversarial_loss(fake_logits: Float[Array, "*batch"]) -> Float[Array, ""]:
    """The generator's adversarial loss: its maps should pass as real (PhysXNet, equation 2).

    Note (differs from the paper):
        Equation 2 prints 1 - log D; the constant has no gradient and is left out.
    """
    ones = jnp.ones_like(fake_logits)
    return jnp.mean(optax.sigmoid_binary_cross_entropy(fake_logits, ones))


def masked_l1(
    predicted: Float[Array, "batch texels 3"],
    target: Float[Array, "batch texels 3"],
    valid: Bool[Array, " texels"],
    sample_weight: Float[Array, " batch"],
) -> Float[Array, ""]:
    """Mean absolute error over covered texels of the samples that count.

    Args:
        predicted: Normalised offsets.
        target: Normalised offsets.
        valid: Texels the template covers.
        sample_weight: 1 for samples that count, 0 for those without this garment.

    Returns:
        The mean; zero if nothing counts. Values that don't count may be anything, NaN as well.
    """
    return _masked_mean(jnp.abs, predicted, target, valid, sample_weight)


def masked_l2(
    predicted: Float[Array, "batch texels 3"],
    target: Float[Array, "batch texels 3"],
    valid: Bool[Array, " texels"],
    sample_weight: Float[Array, " batch"],
) -> Float[Array, ""]:
    """Mean squared error over the same values as `masked_l1`."""
    return _masked_mean(jnp.square, predicted, target, valid, sample_weight)


def pooled_l1(
    predicted: Float[Array, "batch height width 3"],
    target: Float[Array, "batch height width 3"],
    mask: Float[Array, "batch height width 1"],
    pyramid_levels: int,
) -> Float[Array, ""]:
    """Mean absolute error of maps at several resolutions, each half the previous one.

    An error that changes its sign from texel to texel counts at full resolution only.

    Args:
        predicted: Normalised offset maps.
        target: Normalised offset maps.
        mask: 1 for texels that count.
        pyramid_levels: Number of resolutions.

    Returns:
        The mean over resolutions, each over the texels that count; zero if nothing counts.
    """
    error, total = (predicted - target) * mask, jnp.zeros(())
    weight = jnp.maximum(jnp.sum(mask), 1.0)
    for k in range(pyramid_levels):
        if k:
            n, height, width, _ = error.shape
            error = jnp.sum(error.reshape(n, height // 2, 2, width // 2, 2, 3), axis=(2, 4))
        total = total + jnp.sum(jnp.abs(error)) / (3.0 * weight)
    return total / pyramid_levels


def vertex_loss(
    predicted: Float[Array, "batch vertices 3"],
    target: Float[Array, "batch vertices 3"],
    edges: Int[Array, "edges 2"],
    sample_weight: Float[Array, " batch"],
    distance: Callable[..., Float[Array, ""]],
    edge_share: float,
) -> Float[Array, ""]:
    """Error of offsets at vertices and of their differences along edges.

    An error that is the same at all vertices changes no edge: differences measure only
    strain and folds.

    Args:
        predicted: Normalised offsets.
        target: Normalised offsets.
        edges: Vertex indices of each edge.
        sample_weight: 1 for samples that count, 0 for those without this garment.
        distance: `masked_l1` or `masked_l2`.
        edge_share: Share of the differences in the loss, 0 to 1.
    """
    everywhere = jnp.ones((target.shape[1],), bool)
    value = distance(predicted, target, everywhere, sample_weight)
    if not edge_share:
        return value
    a, b = edges.T
    along = distance(
        predicted[:, b] - predicted[:, a],
        target[:, b] - target[:, a],
        jnp.ones(a.shape, bool),
        sample_weight,
    )
    return (1.0 - edge_share) * value + edge_share * along


def vertex_distance(
    predicted: Float[Array, "batch vertices 3"],
    target: Float[Array, "batch vertices 3"],
    weight: Float[Array, "batch vertices"],
    *,
    squared: bool = False,
) -> Float[Array, ""]:
    """Mean absolute (or squared) error of offsets at vertices.

    Args:
        predicted: Normalised offsets.
        target: Normalised offsets.
        weight: Weight of each vertex; 0 for padding.
        squared: Squared errors.

    Returns:
        The mean; zero if nothing counts.
    """
    gap = predicted - target
    error = jnp.mean(jnp.square(gap) if squared else jnp.abs(gap), axis=2)
    return jnp.sum(weight * error) / jnp.maximum(jnp.sum(weight), 1.0)


def _masked_mean(
    distance: Callable[[Array], Array],
    predicted: Float[Array, "batch texels 3"],
    target: Float[Array, "batch texels 3"],
    valid: Bool[Array, " texels"],
    sample_weight: Float[Array, " batch"],
) -> Float[Array, ""]:
    weight = valid.astype(jnp.float32)[None] * sample_weight[:, None]
    # 0 times NaN is NaN, in the value and in its gradient.
    error = distance(jnp.where(weight[..., None] > 0.0, predicted - target, 0.0))
    error = jnp.sum(error, axis=2) / 3.0
    return jnp.sum(weight * error) / jnp.maximum(jnp.sum(weight), 1.0)
