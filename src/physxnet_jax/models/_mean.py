"""Averages of networks: the mean of their predictions."""

import dataclasses
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Float

from ._blocks import Up
from ._networks import Generator
from ._predictor import Predictor


class MeanGenerator(nnx.Module):
    """The mean of several generators' maps; see `average_networks`."""

    def __init__(self, networks: Sequence[Generator]) -> None:
        self.networks = nnx.List(networks)

    def __call__(
        self, x: Float[Array, "batch height width channels"], templates: Sequence[str]
    ) -> dict[str, Float[Array, "batch height width 3"]]:
        """Normalised offset maps of the requested templates."""
        outputs = [network(x, templates) for network in self.networks]
        share = 1.0 / len(outputs)
        return {t: share * sum((a[t] for a in outputs[1:]), outputs[0][t]) for t in templates}


def average_networks(predictors: Sequence[Predictor]) -> Predictor:
    """A predictor that averages the predictions of several networks.

    Networks trained differently on the same task have partly independent errors. The cost
    is that of all networks together. The result is for inference, not for training or
    saving.

    Args:
        predictors: Predictors with a `Generator` each, of one configuration and with the same
            scales of inputs. Scales of offsets may differ.

    Raises:
        ValueError: No predictors, or predictors with different inputs or outputs.
    """
    if not predictors:
        raise ValueError("no predictors to average.")
    first = predictors[0]
    reference = first.normalisation
    networks = []
    for p in predictors:
        if not _is_compatible(p, first):
            raise ValueError(
                "networks of different configurations, input scales, texels or augmentation."
            )
        network = nnx.merge(p.graph, p.state, copy=True)
        if not isinstance(network, Generator):
            raise ValueError(f"expected a Generator, got {type(network).__name__}.")
        for t in first.config.templates:
            _scale_output(network, t, p.normalisation.offset[t] / reference.offset[t])
        networks.append(network)
    mean = MeanGenerator(networks)
    mean.eval()
    graph, state = nnx.split(mean)
    return dataclasses.replace(first, graph=graph, state=state)


def _scale_output(network: Generator, template: str, factor: Float[Array, ""]) -> None:
    last = network.decoders[template].layers[-1]
    if not isinstance(last, Up) or last.bias is None:
        raise ValueError("average networks before their batch norm is folded.")
    last.kernel[...] = last.kernel[...] * factor
    last.bias[...] = last.bias[...] * jnp.broadcast_to(factor, last.bias[...].shape)


def _is_compatible(p: Predictor, first: Predictor) -> bool:
    """Whether two predictors have the same inputs and outputs."""
    if p.config != first.config or p.mirror_tta != first.mirror_tta:
        return False
    a, b = p.normalisation, first.normalisation
    scales = ((a.velocity, b.velocity), (a.acceleration, b.acceleration))
    return all(np.isclose(float(x), float(y), rtol=1e-4) for x, y in scales) and all(
        np.array_equal(p.texel_points.valid[t], first.texel_points.valid[t])
        for t in first.config.templates
    )
