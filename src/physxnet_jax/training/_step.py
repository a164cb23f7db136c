"""One training step: discriminator, then generator, as one jitted function."""

import contextlib
import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import nnx
from jaxtyping import Array, Key

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
        discriminator: Parameters of D (empty without one).
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
    inputs, templates = config.model.inputs, config.model.templates
    g_graph, g_params, g_rest = nnx.split(
        make_generator(config.model, seed=config.seed), nnx.Param, ...
    )
    judge = Discriminator(
        inputs.channels + 3 * len(templates),
        width=config.discriminator_width,
        rngs=nnx.Rngs(config.seed + 1),
    )
    d_graph, d_params, d_rest = nnx.split(judge, nnx.Param, ...)
    kernel_rate = config.kernel_rate if config.optimiser == "muon" else None
    g_tx = make_optimiser(config, config.learning_rate, steps, kernel_rate=kernel_rate)
    d_tx = make_optimiser(config, config.discriminator_rate, steps)
    state = TrainState(
        g_params,
        g_rest,
        d_params,
        d_rest,
        g_tx.init(g_params),
        d_tx.init(d_params),
        jnp.zeros((), jnp.int32),
    )

    dtype = jnp.dtype(config.precision)

    def lower(tree: Any) -> Any:
        return jax.tree.map(lambda v: v.astype(dtype), tree)

    def generate(
        params: Any, rest: Any, x: Array, training: bool = True
    ) -> tuple[dict[str, Array], Any]:
        network = nnx.merge(g_graph, lower(params), rest, copy=True)
        if training:
            network.train()
        else:
            network.eval()
        with _mixed():
            out = network(x.astype(dtype), templates)
        return {t: m.astype(jnp.float32) for t, m in out.items()}, nnx.state(
            network, nnx.Not(nnx.Param)
        )

    def judge_maps(params: Any, rest: Any, x: Array, y: Array) -> tuple[Array, Any]:
        network = nnx.merge(d_graph, lower(params), rest, copy=True)
        network.train()
        with _mixed():
            out = network(x.astype(dtype), y.astype(dtype))
        return out.astype(jnp.float32), nnx.state(network, nnx.Not(nnx.Param))

    def stack(maps: dict[str, Array], masks: dict[str, Array]) -> Array:
        return jnp.concatenate([maps[t] * masks[t] for t in templates], axis=-1)

    def prepare(batch: Batch) -> tuple[Array, dict[str, Array], dict[str, Array]]:
        """Motion maps, wanted offsets at texels over their scale, and what counts."""
        features = jax.vmap(clip_features, in_axes=(None, None, 0, 0, None, None))(
            surface.rest,
            surface.weights,
            batch["rotations"],
            batch["translations"],
            fps,
            inputs,
        )
        x = atlas.to_map(normalise(features[:, 0], normalisation, inputs))
        targets, masks = {}, {}
        for t in templates:
            c = tables[t]
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
            targets[t] = meters / normalisation.offset[t]
            seen = surface.valid[t].astype(jnp.float32)[None, :, None]
            weight = batch[f"weight_{t}"][:, None, None]
            masks[t] = atlas.to_map(seen * weight)
        return x, targets, masks

    distance = masked_l2 if config.squared else masked_l1

    def at_vertices(texels: Array, target: Array, name: str, weight: Array, scale: Array) -> Array:
        """Error of offsets as `dress_frames` reads them, over their scale."""
        wearable = tables[name].wearable
        seen = jnp.where(surface.valid[name][None, :, None], texels, 0.0)
        wanted = target.astype(jnp.float32) * QUANTUM / scale
        return vertex_loss(
            wearable.sample(seen), wanted, tables[name].edges, weight, distance, config.edge_share
        )

    def at_texels(
        maps: Array, texels: Array, target: Array, name: str, weight: Array, mask: Array
    ) -> Array:
        if config.scales == 1:
            return distance(texels, target, surface.valid[name], weight)
        return pooled_l1(maps, atlas.to_map(target), mask, config.scales)

    @jax.jit
    def look(
        state: TrainState, batch: Batch
    ) -> tuple[dict[str, Array], dict[str, tuple[Array, Array]]]:
        x, targets, masks = prepare(batch)
        maps, _ = generate(state.generator, state.generator_rest, x, training=False)
        losses, shown = {}, {}
        for t in templates:
            scale = normalisation.offset[t]
            weight = batch[f"weight_{t}"]
            l1 = masked_l1(atlas.from_map(maps[t]), targets[t], surface.valid[t], weight)
            losses[t] = 1e3 * l1 * scale
            shown[t] = (maps[t] * masks[t] * scale, atlas.to_map(targets[t]) * masks[t] * scale)
        return losses, shown

    @jax.jit
    def step(
        state: TrainState, batch: Batch, key: Key[Array, ""]
    ) -> tuple[TrainState, dict[str, Array]]:
        x, targets, masks = prepare(batch)
        real = stack({t: atlas.to_map(v) for t, v in targets.items()}, masks)

        def generator_loss(params: Any) -> tuple[Array, tuple]:
            maps, rest = generate(params, state.generator_rest, x)
            total = jnp.zeros(())
            parts = {}
            for t in templates:
                texels, weight = atlas.from_map(maps[t]), batch[f"weight_{t}"]
                parts[t] = masked_l1(texels, targets[t], surface.valid[t], weight)
                value = at_texels(maps[t], texels, targets[t], t, weight, masks[t])
                if config.vertex_share:
                    read = at_vertices(
                        texels, batch[f"target_{t}"], t, weight, normalisation.offset[t]
                    )
                    value = (1.0 - config.vertex_share) * value + config.vertex_share * read
                total = total + value / len(templates)
            fake = stack(maps, masks)
            adv = jnp.zeros(())
            if config.adversarial:
                logits, _ = judge_maps(state.discriminator, state.discriminator_rest, x, fake)
                adv = adversarial_loss(logits)
            return adv + config.l1_weight * total, (rest, fake, total, adv, parts)

        (loss, (g_rest, fake, total, adv, parts)), grads = jax.value_and_grad(
            generator_loss, has_aux=True
        )(state.generator)
        updates, g_opt = _update(g_tx, grads, state.generator_opt, state.generator)
        g_params = optax.apply_updates(state.generator, updates)
        ok = jnp.isfinite(loss)
        g_rest = jax.tree.map(
            lambda new, old: jnp.where(ok, new, old), g_rest, state.generator_rest
        )
        kind = "l2" if config.squared else "l1"
        metrics = {"loss": loss, kind: total, "adversarial": adv}
        metrics |= {f"l1_mm_{t}": 1e3 * parts[t] * normalisation.offset[t] for t in templates}
        metrics["skipped"] = g_opt.total_notfinite  # pyright: ignore[reportAttributeAccessIssue]
        d_params, d_rest, d_opt = (
            state.discriminator,
            state.discriminator_rest,
            state.discriminator_opt,
        )
        if config.adversarial:
            still = jax.lax.stop_gradient(fake)

            def judge_loss(params: Any) -> tuple[Array, tuple]:
                real_logits, rest = judge_maps(params, state.discriminator_rest, x, real)
                fake_logits, rest = judge_maps(params, rest, x, still)
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

            (d_loss, (d_rest, accuracy)), d_grads = jax.value_and_grad(judge_loss, has_aux=True)(
                state.discriminator
            )
            d_updates, d_opt = _update(d_tx, d_grads, state.discriminator_opt, state.discriminator)
            d_params = optax.apply_updates(state.discriminator, d_updates)
            fine = jnp.isfinite(d_loss)
            d_rest = jax.tree.map(
                lambda new, old: jnp.where(fine, new, old), d_rest, state.discriminator_rest
            )
            metrics |= {"discriminator": d_loss, "discriminator_accuracy": accuracy}
        new = TrainState(g_params, g_rest, d_params, d_rest, g_opt, d_opt, state.step + 1)
        return new, metrics

    return Steps(state, step, look, g_graph)


def _mixed() -> contextlib.AbstractContextManager[Any]:
    """Batch statistics stay float32, whatever the network computes in."""
    return jax.numpy_dtype_promotion("standard")


def _update(tx: optax.GradientTransformation, grads: Any, state: Any, params: Any) -> Any:
    # optax raises floats to integer powers, which strict promotion forbids.
    with jax.numpy_dtype_promotion("standard"):
        return tx.update(grads, state, params)
