"""Several networks asked as one: the mean of what they answer."""

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
        """Normalised offset maps of the templates asked for."""
        answers = [network(x, templates) for network in self.networks]
        share = 1.0 / len(answers)
        return {t: share * sum((a[t] for a in answers[1:]), answers[0][t]) for t in templates}


def average_networks(predictors: Sequence[Predictor]) -> Predictor:
    """A predictor that asks several networks and averages their answers.

    Networks that learned the same in different ways err in part in different directions.
    As many times one network's work as there are networks; the result is for answers,
    not for training or saving.

    Args:
        predictors: Predictors with a `Generator` each, of one configuration, that see
            motion at the same scales. Offsets may be scaled differently.

    Raises:
        ValueError: None, or predictors that don't see and answer the same.
    """
    if not predictors:
        raise ValueError("no predictors to average.")
    first = predictors[0]
    seen = first.normalisation
    networks = []
    for p in predictors:
        scales = [(seen.velocity, p.normalisation.velocity)]
        scales.append((seen.acceleration, p.normalisation.acceleration))
        alike = all(np.isclose(float(a), float(b), rtol=1e-4) for a, b in scales)
        alike &= all(
            np.array_equal(p.surface.valid[t], first.surface.valid[t])
            for t in first.config.templates
            if p.config == first.config
        )
        ways = (p.mirrored, p.relaxation) == (first.mirrored, first.relaxation)
        if p.config != first.config or not ways or not alike:
            raise ValueError(
                "networks of different configurations, input scales, texels or relaxation."
            )
        network = nnx.merge(p.graph, p.state, copy=True)
        if not isinstance(network, Generator):
            raise ValueError(f"a Generator is wanted, got {type(network).__name__}.")
        for t in first.config.templates:
            _scale_answer(network, t, p.normalisation.offset[t] / seen.offset[t])
        networks.append(network)
    mean = MeanGenerator(networks)
    mean.eval()
    graph, state = nnx.split(mean)
    return dataclasses.replace(first, graph=graph, state=state)


def _scale_answer(network: Generator, template: str, factor: Float[Array, ""]) -> None:
    last = network.decoders[template].layers[-1]
    if not isinstance(last, Up) or last.bias is None:
        raise ValueError("networks are averaged before their batch norm is folded.")
    last.kernel[...] = last.kernel[...] * factor
    last.bias[...] = last.bias[...] * jnp.broadcast_to(factor, last.bias[...].shape)
