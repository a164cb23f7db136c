"""What a run learns: maps, loss, networks and optimizers, and the state that changes."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import optax
from flax import nnx
from jaxtyping import Array, Bool, Float

from ..models import (
    Discriminator,
    Normalisation,
    TexelPoints,
    make_generator,
)
from ..typing import pytree
from ..uv import Atlas
from ._config import TrainConfig
from ._garment_tables import GarmentTables, Persons
from ._losses import (
    masked_l1,
    masked_l2,
    pooled_l1,
    vertex_distance,
    vertex_loss,
)
from ._optimizer import make_optimizer
from ._targets import ClothTables


@pytree
@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainState:
    """All state that changes from step to step; saved as a whole.

    Attributes:
        generator: Parameters of G.
        generator_rest: Its batch statistics.
        discriminator: Parameters of D; empty without one.
        discriminator_rest: Its batch statistics.
        generator_opt: Optimizer state of G.
        discriminator_opt: Optimizer state of D.
        step: Steps done.
    """

    generator: Any
    generator_rest: Any
    discriminator: Any
    discriminator_rest: Any
    generator_opt: Any
    discriminator_opt: Any
    step: Array


@pytree
@dataclasses.dataclass(frozen=True, kw_only=True)
class LossInputs:
    """What a loss compares for one template; lengths are relative to its offset scale.

    Attributes:
        maps: Predicted maps, shape [batch, height, width, 3].
        texels: The same at covered texels, shape [batch, texels, 3].
        target: Targets at texels, shape [batch, texels, 3]; None where every sample has a garment
            of its own.
        valid: Texels that the template covers, shape [texels].
        weight: Weight of each sample, shape [batch].
        vertices: Predictions sampled at the garment's vertices as in `dress_frames`, shape
            [batch, vertices, 3].
        vertex_target: Targets there, shape [batch, vertices, 3].
        present: 1 for vertices, 0 for padding, shape [batch, vertices].
        edges: Vertices of the garment's edges, shape [edges, 2]; None where every sample has a
            garment of its own.
        means: Means of ``vertices`` over patches of 8 cm, of ``vertex_target``, and the weights of
            the patches, where every sample has a garment of its own; else None.
        differences: The same of differences along edges.
        elastic: Elastic energy of the predicted cloth over that of lifting it by 1 cm, in units
            in which an error of 1 cm is 1, shape [batch]; None if it doesn't count.
        atlas: The atlas of the maps.
    """

    maps: Float[Array, "batch height width 3"]
    texels: Float[Array, "batch texels 3"]
    target: Float[Array, "batch texels 3"] | None
    valid: Bool[Array, " texels"]
    weight: Float[Array, " batch"]
    vertices: Float[Array, "batch vertices 3"]
    vertex_target: Float[Array, "batch vertices 3"]
    present: Float[Array, "batch vertices"]
    edges: Array | None
    means: tuple[Array, Array, Array] | None
    differences: tuple[Array, Array, Array] | None
    elastic: Float[Array, " batch"] | None
    atlas: Atlas


Loss = Callable[[LossInputs], Float[Array, ""]]
"""The loss of one template; pure."""


@pytree
@dataclasses.dataclass(frozen=True, kw_only=True)
class Problem:
    """What is learned: maps in, maps wanted, loss, networks and optimizers.

    Attributes:
        atlas: The atlas of all maps.
        texel_points: Its texels on the body.
        normalisation: Scales of inputs and outputs.
        tables: What turns a template's stored offsets into targets.
        persons: Bodies, for a network that sees garments.
        motion_atlas: The atlas of the maps of motion.
        config: Settings of the run.
        fps: Frames a second.
        loss: The loss of one template.
        generator: Structure of the generator.
        discriminator: Structure of the discriminator; None without one.
        optimizer: Optimizer of the generator.
        discriminator_optimizer: Optimizer of the discriminator.
    """

    atlas: Atlas
    texel_points: TexelPoints
    normalisation: Normalisation
    tables: dict[str, ClothTables] | dict[str, GarmentTables]
    persons: Persons | None
    motion_atlas: Atlas
    config: TrainConfig = dataclasses.field(metadata={"static": True})
    fps: float = dataclasses.field(metadata={"static": True})
    loss: Loss = dataclasses.field(metadata={"static": True})
    generator: Any = dataclasses.field(metadata={"static": True})
    discriminator: Any = dataclasses.field(metadata={"static": True})
    optimizer: optax.GradientTransformation = dataclasses.field(metadata={"static": True})
    discriminator_optimizer: optax.GradientTransformation = dataclasses.field(
        metadata={"static": True}
    )


def configured_loss(config: TrainConfig) -> Loss:
    """The loss that a configuration describes.

    Args:
        config: Its ``loss``, ``pyramid_levels``, ``elastic_weight`` and shares count.
    """
    distance = masked_l2 if config.loss == "l2" else masked_l1

    def loss(x: LossInputs) -> Float[Array, ""]:
        if x.target is None or x.edges is None or x.means is not None:
            squared, weight = config.loss == "l2", x.weight[:, None]
            total = vertex_distance(
                x.vertices, x.vertex_target, x.present * weight, squared=squared
            )
            for share, found in (
                (config.patch_share, x.means),
                (config.edge_share, x.differences),
            ):
                if share and found is not None:
                    ours, theirs, each = found
                    part = vertex_distance(ours, theirs, each * weight, squared=squared)
                    total = (1.0 - share) * total + share * part
            if config.elastic_weight and x.elastic is not None:
                count = jnp.maximum(jnp.sum(x.weight), 1.0)
                total = total + config.elastic_weight * jnp.sum(x.weight * x.elastic) / count
            return total
        if config.pyramid_levels == 1:
            at_texels = distance(x.texels, x.target, x.valid, x.weight)
        else:
            seen = x.valid.astype(jnp.float32)[None, :, None]
            mask = x.atlas.to_map(seen * x.weight[:, None, None])
            target = x.atlas.to_map(x.target)
            at_texels = pooled_l1(x.maps, target, mask, config.pyramid_levels)
        if not config.vertex_share:
            return at_texels
        at_vertices = vertex_loss(
            x.vertices, x.vertex_target, x.edges, x.weight, distance, config.edge_share
        )
        return (1.0 - config.vertex_share) * at_texels + config.vertex_share * at_vertices

    return loss


def make_problem(
    config: TrainConfig,
    atlas: Atlas,
    texel_points: TexelPoints,
    normalisation: Normalisation,
    tables: dict[str, ClothTables] | dict[str, GarmentTables],
    *,
    persons: Persons | None = None,
    motion_atlas: Atlas | None = None,
    fps: float,
    steps: int,
    network: nnx.Module | None = None,
    loss: Loss | None = None,
    optimizer: optax.GradientTransformation | None = None,
) -> tuple[Problem, TrainState]:
    """A problem and the state before its first step.

    Args:
        config: Settings of the run.
        atlas: The atlas of all maps.
        texel_points: Its texels on the body.
        normalisation: Scales of inputs and outputs.
        tables: For each template, what turns stored offsets into targets.
        persons: Bodies, for a network that sees garments.
        motion_atlas: The atlas of the maps of motion; ``atlas`` if None.
        fps: Frames a second.
        steps: Length of the run in steps.
        network: Any module with the signature of `Generator`; a `Generator` by default.
        loss: The loss of one template; `configured_loss` by default.
        optimizer: The generator's optimizer; `make_optimizer` by default.
    """
    templates = config.model.templates
    network = make_generator(config.model, seed=config.seed) if network is None else network
    network.train()
    g_graph, g_params, g_rest = nnx.split(network, nnx.Param, ...)
    d_graph, d_params, d_rest = None, {}, {}
    if config.adversarial:
        discriminator = Discriminator(
            config.model.inputs.channels + 3 * len(templates),
            width=config.discriminator_width,
            rngs=nnx.Rngs(config.seed + 1),
        )
        d_graph, d_params, d_rest = nnx.split(discriminator, nnx.Param, ...)
    if optimizer is None:
        muon = config.muon_learning_rate if config.optimizer == "muon" else None
        optimizer = make_optimizer(config, config.learning_rate, steps, muon_learning_rate=muon)
    else:
        optimizer = optax.apply_if_finite(optimizer, 2**31 - 2)
    d_optimizer = make_optimizer(config, config.discriminator_rate, steps)
    problem = Problem(
        atlas=atlas,
        texel_points=texel_points,
        normalisation=normalisation,
        tables=tables,
        persons=persons,
        motion_atlas=atlas if motion_atlas is None else motion_atlas,
        config=config,
        fps=fps,
        loss=configured_loss(config) if loss is None else loss,
        generator=g_graph,
        discriminator=d_graph,
        optimizer=optimizer,
        discriminator_optimizer=d_optimizer,
    )
    state = TrainState(
        generator=g_params,
        generator_rest=g_rest,
        discriminator=d_params,
        discriminator_rest=d_rest,
        generator_opt=optimizer.init(g_params),
        discriminator_opt=d_optimizer.init(d_params),
        step=jnp.zeros((), jnp.int32),
    )
    return problem, state
