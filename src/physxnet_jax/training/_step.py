"""One training step: discriminator, then generator, as one jitted function."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import nnx
from jaxtyping import Array, Key

from ..models import (
    Discriminator,
    Normalisation,
    Surface,
    clip_features,
    make_generator,
    normalise,
    num_channels,
)
from ..typing import pytree
from ..uv import Atlas, Transference
from ._batches import target_offsets
from ._config import TrainConfig
from ._losses import adversarial_loss, discriminator_loss, masked_l1, soft_labels


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
    """

    to_cloth: Transference
    rest: Array
    skin: Array
    anchor: Array
    anchor_weights: Array


def make_optimiser(config: TrainConfig, rate: float, steps: int) -> optax.GradientTransformation:
    """Adam as in the paper; updates that aren't finite are skipped and counted."""
    schedule = (
        optax.cosine_decay_schedule(rate, max(steps, 1))
        if config.schedule == "cosine"
        else optax.constant_schedule(rate)
    )
    # The loop gives up after max_skipped; the optimiser itself must never let one in.
    return optax.apply_if_finite(optax.adam(schedule, b1=0.5), 2**31 - 2)


def make_step(
    config: TrainConfig,
    atlas: Atlas,
    surface: Surface,
    normalisation: Normalisation,
    tables: dict[str, ClothTables],
    fps: float,
    steps: int,
) -> tuple[TrainState, Callable[[TrainState, dict, Key[Array, ""]], tuple[TrainState, dict]], Any]:
    """The first state, the step function and the generator's graph."""
    family, templates = config.model.family, config.model.templates
    g_graph, g_params, g_rest = nnx.split(
        make_generator(config.model, seed=config.seed), nnx.Param, ...
    )
    judge = Discriminator(
        num_channels(family) + 3 * len(templates),
        width=config.discriminator_width,
        rngs=nnx.Rngs(config.seed + 1),
    )
    d_graph, d_params, d_rest = nnx.split(judge, nnx.Param, ...)
    g_tx = make_optimiser(config, config.learning_rate, steps)
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

    def generate(params: Any, rest: Any, x: Array) -> tuple[dict[str, Array], Any]:
        network = nnx.merge(g_graph, params, rest, copy=True)
        network.train()
        out = network(x, templates)
        return {t: m.astype(jnp.float32) for t, m in out.items()}, nnx.state(
            network, nnx.Not(nnx.Param)
        )

    def judge_maps(params: Any, rest: Any, x: Array, y: Array) -> tuple[Array, Any]:
        network = nnx.merge(d_graph, params, rest, copy=True)
        network.train()
        return network(x, y), nnx.state(network, nnx.Not(nnx.Param))

    def stack(maps: dict[str, Array], masks: dict[str, Array]) -> Array:
        return jnp.concatenate([maps[t] * masks[t] for t in templates], axis=-1)

    @jax.jit
    def step(
        state: TrainState, batch: dict[str, Array], key: Key[Array, ""]
    ) -> tuple[TrainState, dict]:
        features = jax.vmap(clip_features, in_axes=(None, None, 0, 0, None, None))(
            surface.rest,
            surface.weights,
            batch["rotations"],
            batch["translations"],
            fps,
            family,
        )
        x = atlas.to_map(normalise(features[:, 0], normalisation, family))
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
                family,
            )
            targets[t] = meters / normalisation.offset[t]
            seen = surface.valid[t].astype(jnp.float32)[None, :, None]
            weight = batch[f"weight_{t}"][:, None, None]
            masks[t] = atlas.to_map(seen * weight)
        real = stack({t: atlas.to_map(v) for t, v in targets.items()}, masks)

        def generator_loss(params: Any) -> tuple[Array, tuple]:
            maps, rest = generate(params, state.generator_rest, x)
            l1 = jnp.zeros(())
            parts = {}
            for t in templates:
                parts[t] = masked_l1(
                    atlas.from_map(maps[t]), targets[t], surface.valid[t], batch[f"weight_{t}"]
                )
                l1 = l1 + parts[t] / len(templates)
            fake = stack(maps, masks)
            adv = jnp.zeros(())
            if config.adversarial:
                logits, _ = judge_maps(state.discriminator, state.discriminator_rest, x, fake)
                adv = adversarial_loss(logits)
            return adv + config.l1_weight * l1, (rest, fake, l1, adv, parts)

        (loss, (g_rest, fake, l1, adv, parts)), grads = jax.value_and_grad(
            generator_loss, has_aux=True
        )(state.generator)
        updates, g_opt = _update(g_tx, grads, state.generator_opt, state.generator)
        g_params = optax.apply_updates(state.generator, updates)
        ok = jnp.isfinite(loss)
        g_rest = jax.tree.map(
            lambda new, old: jnp.where(ok, new, old), g_rest, state.generator_rest
        )
        metrics = {"loss": loss, "l1": l1, "adversarial": adv}
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

    return state, step, g_graph


def _update(tx: optax.GradientTransformation, grads: Any, state: Any, params: Any) -> Any:
    # optax raises floats to integer powers, which strict promotion forbids.
    with jax.numpy_dtype_promotion("standard"):
        return tx.update(grads, state, params)
