"""One training step: generator, then discriminator on the same maps, as one jitted function."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import nnx
from jaxtyping import Array, Float, Key

from ..data import QUANTUM
from ..models import (
    Discriminator,
    Normalisation,
    Surface,
    Wearable,
    clip_features,
    make_generator,
    normalise,
)
from ..typing import pytree
from ..uv import Atlas, Transference
from ._batches import target_offsets
from ._config import TrainConfig
from ._losses import (
    adversarial_loss,
    discriminator_loss,
    masked_l1,
    masked_l2,
    pooled_l1,
    soft_labels,
    vertex_loss,
)
from ._optimiser import make_optimiser

Batch = dict[str, Any]


@pytree
@dataclasses.dataclass(frozen=True)
class TrainState:
    """All that changes from step to step; saved whole.

    Attributes:
        generator: Parameters of G.
        generator_rest: Its batch statistics.
        discriminator: Parameters of D; empty without one.
        discriminator_rest: Its batch statistics.
        generator_opt: Optimiser state of G.
        discriminator_opt: Optimiser state of D.
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
@dataclasses.dataclass(frozen=True)
class ClothTables:
    """What turns a template's stored offsets into texel targets.

    Attributes:
        to_cloth: T_BC.
        rest: Garment vertices at rest [m].
        skin: Their skinning weights.
        anchor: Texel points at rest that the offsets start from [m].
        anchor_weights: Their skinning weights.
        wearable: The template as it is dressed.
        edges: Vertices of its edges, shape [edges, 2].
    """

    to_cloth: Transference
    rest: Array
    skin: Array
    anchor: Array
    anchor_weights: Array
    wearable: Wearable
    edges: Array


@dataclasses.dataclass(frozen=True)
class Steps:
    """A run's functions, all jitted.

    Attributes:
        first: The state before the first step.
        step: From a state, a batch and a key to the next state and metrics.
        look: From a state and a batch to the loss of the network as it would be used,
            and its maps: predicted and wanted offsets [m] for each template.
        graph: Structure of the generator.
    """

    first: TrainState
    step: Callable[[TrainState, Batch, Key[Array, ""]], tuple[TrainState, dict[str, Array]]]
    look: Callable[[TrainState, Batch], tuple[dict[str, Array], dict[str, tuple[Array, Array]]]]
    graph: Any


@dataclasses.dataclass(frozen=True)
class _Task:
    """What is to be learned: maps to see, maps wanted, and how far an answer is from them."""

    config: TrainConfig
    atlas: Atlas
    surface: Surface
    normalisation: Normalisation
    tables: dict[str, ClothTables]
    fps: float

    def prepare(self, batch: Batch) -> tuple[Array, dict[str, Array], dict[str, Array]]:
        """Motion maps, wanted offsets at texels over their scale, and what counts."""
        inputs, surface = self.config.model.inputs, self.surface
        features = jax.vmap(clip_features, in_axes=(None, None, 0, 0, None, None))(
            surface.rest,
            surface.weights,
            batch["rotations"],
            batch["translations"],
            self.fps,
            inputs,
        )
        x = self.atlas.to_map(normalise(features[:, 0], self.normalisation, inputs))
        targets, masks = {}, {}
        for t in self.config.model.templates:
            c = self.tables[t]
            meters = target_offsets(
                batch[f"target_{t}"],
                c.to_cloth,
                c.rest,
                c.skin,
                c.anchor,
                c.anchor_weights,
                batch["rotations"][:, -1],
                batch["translations"][:, -1],
                inputs.family,
            )
            targets[t] = meters / self.normalisation.offset[t]
            seen = surface.valid[t].astype(jnp.float32)[None, :, None]
            masks[t] = self.atlas.to_map(seen * batch[f"weight_{t}"][:, None, None])
        return x, targets, masks

    def stack(self, maps: dict[str, Array], masks: dict[str, Array]) -> Array:
        """All templates' maps as one, where they count: what D judges."""
        return jnp.concatenate([maps[t] * masks[t] for t in self.config.model.templates], axis=-1)

    def mean_error(
        self, t: str, texels: Array, targets: dict[str, Array], batch: Batch
    ) -> Float[Array, ""]:
        """L1 at texels over their scale: what is shown, whatever is minimised."""
        return masked_l1(texels, targets[t], self.surface.valid[t], batch[f"weight_{t}"])

    def loss(
        self,
        t: str,
        maps: Array,
        texels: Array,
        targets: dict[str, Array],
        masks: dict[str, Array],
        batch: Batch,
    ) -> Float[Array, ""]:
        """What is minimised of a template, but for what D says."""
        config, target, weight = self.config, targets[t], batch[f"weight_{t}"]
        distance = masked_l2 if config.squared else masked_l1
        if config.scales == 1:
            at_texels = distance(texels, target, self.surface.valid[t], weight)
        else:
            at_texels = pooled_l1(maps, self.atlas.to_map(target), masks[t], config.scales)
        if not config.vertex_share:
            return at_texels
        # Of offsets as `dress_frames` reads them, over their scale.
        seen = jnp.where(self.surface.valid[t][None, :, None], texels, 0.0)
        stored = batch[f"target_{t}"].astype(jnp.float32) * QUANTUM
        at_vertices = vertex_loss(
            self.tables[t].wearable.sample(seen),
            stored / self.normalisation.offset[t],
            self.tables[t].edges,
            weight,
            distance,
            config.edge_share,
        )
        return (1.0 - config.vertex_share) * at_texels + config.vertex_share * at_vertices


def make_step(
    config: TrainConfig,
    atlas: Atlas,
    surface: Surface,
    normalisation: Normalisation,
    tables: dict[str, ClothTables],
    fps: float,
    steps: int,
) -> Steps:
    """The first state and the functions of a run."""
    task = _Task(config, atlas, surface, normalisation, tables, fps)
    templates, dtype = config.model.templates, jnp.dtype(config.precision)
    g_graph, g_params, g_rest = nnx.split(
        make_generator(config.model, seed=config.seed), nnx.Param, ...
    )
    d_graph, d_params, d_rest = None, {}, {}
    if config.adversarial:
        judge = Discriminator(
            config.model.inputs.channels + 3 * len(templates),
            width=config.discriminator_width,
            rngs=nnx.Rngs(config.seed + 1),
        )
        d_graph, d_params, d_rest = nnx.split(judge, nnx.Param, ...)
    kernel_rate = config.kernel_rate if config.optimiser == "muon" else None
    g_tx = make_optimiser(config, config.learning_rate, steps, kernel_rate=kernel_rate)
    d_tx = make_optimiser(config, config.discriminator_rate, steps)
    first = TrainState(
        g_params,
        g_rest,
        d_params,
        d_rest,
        g_tx.init(g_params),
        d_tx.init(d_params),
        jnp.zeros((), jnp.int32),
    )

    @jax.jit
    def look(
        state: TrainState, batch: Batch
    ) -> tuple[dict[str, Array], dict[str, tuple[Array, Array]]]:
        x, targets, masks = task.prepare(batch)
        maps, _ = _ask(
            g_graph, state.generator, state.generator_rest, x, templates, dtype=dtype, train=False
        )
        losses, shown = {}, {}
        for t in templates:
            scale = normalisation.offset[t]
            losses[t] = 1e3 * scale * task.mean_error(t, atlas.from_map(maps[t]), targets, batch)
            shown[t] = (maps[t] * masks[t] * scale, atlas.to_map(targets[t]) * masks[t] * scale)
        return losses, shown

    @jax.jit
    def step(
        state: TrainState, batch: Batch, key: Key[Array, ""]
    ) -> tuple[TrainState, dict[str, Array]]:
        x, targets, masks = task.prepare(batch)

        def generator_loss(params: Any) -> tuple[Array, tuple]:
            maps, rest = _ask(g_graph, params, state.generator_rest, x, templates, dtype=dtype)
            total, parts = jnp.zeros(()), {}
            for t in templates:
                texels = atlas.from_map(maps[t])
                parts[t] = task.mean_error(t, texels, targets, batch)
                loss = task.loss(t, maps[t], texels, targets, masks, batch)
                total = total + loss / len(templates)
            fake = task.stack(maps, masks)
            adv = jnp.zeros(())
            if config.adversarial:
                judged = (state.discriminator, state.discriminator_rest)
                logits, _ = _ask(d_graph, *judged, x, fake, dtype=dtype)
                adv = adversarial_loss(logits)
            return adv + config.l1_weight * total, (rest, fake, total, adv, parts)

        (loss, (g_rest, fake, total, adv, parts)), grads = jax.value_and_grad(
            generator_loss, has_aux=True
        )(state.generator)
        updates, g_opt = _update(g_tx, grads, state.generator_opt, state.generator)
        g_params = optax.apply_updates(state.generator, updates)
        g_rest = _kept(jnp.isfinite(loss), g_rest, state.generator_rest)
        kind = "l2" if config.squared else "l1"
        metrics = {"loss": loss, kind: total, "adversarial": adv}
        metrics |= {f"l1_mm_{t}": 1e3 * parts[t] * normalisation.offset[t] for t in templates}
        metrics["skipped"] = g_opt.total_notfinite  # pyright: ignore[reportAttributeAccessIssue]
        judge = (state.discriminator, state.discriminator_rest, state.discriminator_opt)
        if config.adversarial:
            wanted = {t: atlas.to_map(v) for t, v in targets.items()}
            judge, told = _teach_judge(
                d_graph, d_tx, judge, x, task.stack(wanted, masks), fake, key, dtype
            )
            metrics |= told
        d_params, d_rest, d_opt = judge
        new = TrainState(g_params, g_rest, d_params, d_rest, g_opt, d_opt, state.step + 1)
        return new, metrics

    return Steps(first, step, look, g_graph)


def _teach_judge(
    graph: Any,
    tx: optax.GradientTransformation,
    judge: tuple[Any, Any, Any],
    x: Array,
    real: Array,
    fake: Array,
    key: Key[Array, ""],
    dtype: Any,
) -> tuple[tuple[Any, Any, Any], dict[str, Array]]:
    """A step of D: its parameters, statistics and optimiser's state, and what to tell of it."""
    params, statistics, opt = judge
    fake = jax.lax.stop_gradient(fake)

    def judge_loss(params: Any) -> tuple[Array, tuple]:
        real_logits, rest = _ask(graph, params, statistics, x, real, dtype=dtype)
        fake_logits, rest = _ask(graph, params, rest, x, fake, dtype=dtype)
        k_real, k_fake = jax.random.split(key)
        value = discriminator_loss(
            real_logits,
            fake_logits,
            soft_labels(k_real, real_logits.shape, real=True),
            soft_labels(k_fake, fake_logits.shape, real=False),
        )
        right = jnp.mean((real_logits > 0).astype(jnp.float32)) + jnp.mean(
            (fake_logits < 0).astype(jnp.float32)
        )
        return value, (rest, 0.5 * right)

    (loss, (rest, accuracy)), grads = jax.value_and_grad(judge_loss, has_aux=True)(params)
    updates, opt = _update(tx, grads, opt, params)
    learned = optax.apply_updates(params, updates)
    told = {"discriminator": loss, "discriminator_accuracy": accuracy}
    return (learned, _kept(jnp.isfinite(loss), rest, statistics), opt), told


def _ask(
    graph: Any, params: Any, rest: Any, *inputs: Any, dtype: Any, train: bool = True
) -> tuple[Any, Any]:
    """What a network answers, computed in ``dtype``, and its statistics after it."""
    lowered = jax.tree.map(lambda v: v.astype(dtype), params)
    network = nnx.merge(graph, lowered, rest, copy=True)
    if train:
        network.train()
    else:
        network.eval()
    # Batch statistics stay float32, whatever the network computes in.
    with jax.numpy_dtype_promotion("standard"):
        out = network(*(x.astype(dtype) if isinstance(x, jax.Array) else x for x in inputs))
    answers = jax.tree.map(lambda m: m.astype(jnp.float32), out)
    return answers, nnx.state(network, nnx.Not(nnx.Param))


def _kept(fine: Array, new: Any, old: Any) -> Any:
    """Statistics of a batch, or those before it where the batch wasn't finite."""
    return jax.tree.map(lambda a, b: jnp.where(fine, a, b), new, old)


def _update(tx: optax.GradientTransformation, grads: Any, state: Any, params: Any) -> Any:
    # optax raises floats to integer powers, which strict promotion forbids.
    with jax.numpy_dtype_promotion("standard"):
        return tx.update(grads, state, params)
