"""One training step: generator, then discriminator on the same maps, as one jitted function."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import nnx
from jaxtyping import Array, Float, Key

from ..data import QUANTIZATION_STEP
from ..models import clip_features, normalise
from ._garment_tables import ERROR_UNIT, GarmentTables
from ._losses import (
    adversarial_loss,
    discriminator_loss,
    masked_l1,
    soft_labels,
    vertex_distance,
)
from ._problem import LossInputs, Problem, TrainState
from ._targets import target_offsets

Batch = dict[str, Any]


def _prepare(problem: Problem, batch: Batch) -> tuple[Array, dict[str, Array], dict[str, Array]]:
    """Motion maps, normalised targets at texels, and masks of the texels that count."""
    config, points = problem.config, problem.texel_points
    inputs = config.model.inputs
    persons, names = problem.persons, ("rotations", "translations")
    if persons is None:
        rotations, translations = (batch[k] for k in names)
        rest = jnp.broadcast_to(points.rest[None], (len(rotations), *points.rest.shape))
    else:
        # Every template has samples of its own: all of them are one batch of motion.
        rotations, translations = (jnp.concatenate(jnp.unstack(batch[k], axis=1)) for k in names)
        rest = persons.rest[jnp.concatenate(jnp.unstack(batch["person"], axis=1))]
    features = jax.vmap(clip_features, in_axes=(0, None, 0, 0, None, None))(
        rest, points.weights, rotations, translations, problem.fps, inputs
    )
    x = problem.motion_atlas.to_map(normalise(features[:, 0], problem.normalisation, inputs))
    targets, masks = {}, {}
    for t in config.templates:
        table = problem.tables[t]
        # Where every sample has a garment of its own, vertices alone are compared.
        if isinstance(table, GarmentTables):
            continue
        meters = target_offsets(
            batch[f"target_{t}"],
            table,
            points,
            batch["rotations"][:, -1],
            batch["translations"][:, -1],
            inputs.family,
        )
        targets[t] = meters / problem.normalisation.offset[t]
        seen = points.valid[t].astype(jnp.float32)[None, :, None]
        masks[t] = problem.atlas.to_map(seen * batch[f"weight_{t}"][:, None, None])
    return x, targets, masks


def _loss_inputs(
    problem: Problem, t: str, maps: Array, targets: dict[str, Array], batch: Batch
) -> LossInputs:
    scale = problem.normalisation.offset[t]
    valid, table = problem.texel_points.valid[t], problem.tables[t]
    texels = problem.atlas.from_map(maps)
    seen = jnp.where(valid[None, :, None], texels, 0.0)
    stored = batch[f"target_{t}"].astype(jnp.float32) * QUANTIZATION_STEP
    if isinstance(table, GarmentTables):
        garment = batch[f"garment_{t}"]
        vertices, present, edges = table.sample(seen, garment), table.present[garment], None
        scaled = stored / scale
        place = problem.config.templates.index(t)
        elastic = table.elastic_energy(
            scale * vertices,
            garment,
            batch["rotations"][:, place, -1],
            batch["translations"][:, place, -1],
        )
        # Errors are relative to the scale.
        elastic = None if elastic is None else elastic * ERROR_UNIT / scale
        means, differences = (
            (found(vertices, garment)[0], *found(scaled, garment))
            for found in (table.means, table.differences)
        )
    else:
        means, differences, elastic = None, None, None
        vertices, edges = table.bound.sample(seen), table.edges
        present = jnp.ones(vertices.shape[:2], jnp.float32)
    return LossInputs(
        maps=maps,
        texels=texels,
        target=targets.get(t),
        valid=valid,
        weight=batch[f"weight_{t}"],
        vertices=vertices,
        vertex_target=stored / scale,
        present=present,
        edges=edges,
        means=means,
        differences=differences,
        elastic=elastic,
        atlas=problem.atlas,
    )


def _maps_of_garments(
    problem: Problem, network: Any, x: Array, batch: Batch, dtype: Any
) -> dict[str, Array]:
    """Maps of every template for its own samples, which all went through the encoder."""
    config, out = problem.config, {}
    templates, features = config.templates, network.encode(x)
    if config.learned:
        features = jax.lax.stop_gradient(features)
    parts = [jnp.split(f, len(templates)) for f in features]
    for k, t in enumerate(templates):
        conditions = problem.tables[t].conditions[batch[f"garment_{t}"]]  # pyright: ignore
        known = network.modulation(t, conditions.astype(dtype))
        out[t] = network.decode(t, [f[k] for f in parts], known)
    return out


def _mean_error(x: LossInputs) -> Float[Array, ""]:
    """L1 relative to the scale, at texels or else at vertices: reported whatever is minimised."""
    if x.target is None:
        return vertex_distance(x.vertices, x.vertex_target, x.present * x.weight[:, None])
    return masked_l1(x.texels, x.target, x.valid, x.weight)


def _stack(problem: Problem, maps: dict[str, Array], masks: dict[str, Array]) -> Array:
    """All templates' maps as one, where they count: the discriminator's input."""
    return jnp.concatenate([maps[t] * masks[t] for t in problem.config.templates], axis=-1)


@jax.jit
def eval_step(
    problem: Problem, state: TrainState, batch: Batch
) -> tuple[dict[str, Array], dict[str, tuple[Array, Array]]]:
    """Errors of the network in evaluation mode.

    Args:
        problem: From `make_problem`.
        state: Parameters.
        batch: From `take`.

    Returns:
        Mean absolute error of each template [mm], and its predicted and wanted maps [m].
    """
    config = problem.config
    x, targets, masks = _prepare(problem, batch)
    maps, _ = _apply_generator(problem, state.generator, state, x, batch, train=False)
    losses, shown = {}, {}
    for t in config.templates:
        scale = problem.normalisation.offset[t]
        found = _loss_inputs(problem, t, maps[t], targets, batch)
        losses[t] = 1e3 * scale * _mean_error(found)
        if not targets:
            continue
        wanted = problem.atlas.to_map(targets[t])
        shown[t] = (maps[t] * masks[t] * scale, wanted * masks[t] * scale)
    return losses, shown


@jax.jit
def train_step(
    problem: Problem, state: TrainState, batch: Batch, key: Key[Array, ""]
) -> tuple[TrainState, dict[str, Array]]:
    """One step of the generator and, if there is one, of the discriminator.

    Args:
        problem: From `make_problem`; compiled once for each.
        state: The state before the step.
        batch: From `take`.
        key: Random key of the discriminator's labels.

    Returns:
        The state after the step, and metrics.

    References:
        PhysXNet, equations 1 and 2.
    """
    config = problem.config
    templates, dtype = config.templates, jnp.dtype(config.precision)
    x, targets, masks = _prepare(problem, batch)

    def generator_loss(params: Any) -> tuple[Array, tuple]:
        maps, rest = _apply_generator(problem, params, state, x, batch)
        total, parts = jnp.zeros(()), {}
        for t in templates:
            found = _loss_inputs(problem, t, maps[t], targets, batch)
            parts[t] = _mean_error(found)
            total = total + problem.loss(found) / len(templates)
        fake = _stack(problem, maps, masks) if config.adversarial else jnp.zeros(())
        adv = jnp.zeros(())
        if config.adversarial:
            judged = (state.discriminator, state.discriminator_rest)
            logits, _ = _apply_network(problem.discriminator, *judged, x, fake, dtype=dtype)
            adv = adversarial_loss(logits)
        return adv + config.l1_weight * total, (rest, fake, total, adv, parts)

    (loss, (g_rest, fake, total, adv, parts)), grads = jax.value_and_grad(
        generator_loss, has_aux=True
    )(state.generator)
    updates, g_opt = _update(problem.optimizer, grads, state.generator_opt, state.generator)
    metrics = {"loss": loss, config.loss: total, "adversarial": adv}
    for t in templates:
        metrics[f"l1_mm_{t}"] = 1e3 * parts[t] * problem.normalisation.offset[t]
    metrics["skipped"] = g_opt.total_notfinite  # pyright: ignore[reportAttributeAccessIssue]
    d_params, d_rest = state.discriminator, state.discriminator_rest
    d_opt = state.discriminator_opt
    if config.adversarial:
        wanted = {t: problem.atlas.to_map(v) for t, v in targets.items()}
        (d_params, d_rest, d_opt), found = _discriminator_step(
            problem, state, x, _stack(problem, wanted, masks), fake, key
        )
        metrics |= found
    new = TrainState(
        generator=optax.apply_updates(state.generator, updates),
        generator_rest=_where_finite(jnp.isfinite(loss), g_rest, state.generator_rest),
        discriminator=d_params,
        discriminator_rest=d_rest,
        generator_opt=g_opt,
        discriminator_opt=d_opt,
        step=state.step + 1,
    )
    return new, metrics


def _discriminator_step(
    problem: Problem,
    state: TrainState,
    x: Array,
    real: Array,
    fake: Array,
    key: Key[Array, ""],
) -> tuple[tuple[Any, Any, Any], dict[str, Array]]:
    """One step of D: its parameters, statistics and optimizer state, and metrics."""
    apply = functools.partial(
        _apply_network, problem.discriminator, dtype=jnp.dtype(problem.config.precision)
    )
    fake = jax.lax.stop_gradient(fake)

    def loss_of(params: Any) -> tuple[Array, tuple]:
        real_logits, rest = apply(params, state.discriminator_rest, x, real)
        fake_logits, rest = apply(params, rest, x, fake)
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

    (loss, (rest, accuracy)), grads = jax.value_and_grad(loss_of, has_aux=True)(state.discriminator)
    updates, opt = _update(
        problem.discriminator_optimizer, grads, state.discriminator_opt, state.discriminator
    )
    params = optax.apply_updates(state.discriminator, updates)
    rest = _where_finite(jnp.isfinite(loss), rest, state.discriminator_rest)
    metrics = {"discriminator": loss, "discriminator_accuracy": accuracy}
    return (params, rest, opt), metrics


def _apply_network(
    graph: Any,
    params: Any,
    rest: Any,
    *inputs: Any,
    dtype: Any,
    train: bool = True,
    call: Callable[..., Any] | None = None,
) -> tuple[Any, Any]:
    """Output of a network computed in ``dtype``, and its updated statistics."""
    lowered = jax.tree.map(lambda v: v.astype(dtype), params)
    network = nnx.merge(graph, lowered, rest, copy=True)
    if train:
        network.train()
    else:
        network.eval()
    # Batch statistics stay float32, whatever the network computes in.
    with jax.numpy_dtype_promotion("standard"):
        given = (x.astype(dtype) if isinstance(x, jax.Array) else x for x in inputs)
        out = network(*given) if call is None else call(network, *given)
    answers = jax.tree.map(lambda m: m.astype(jnp.float32), out)
    return answers, nnx.state(network, nnx.Not(nnx.Param))


def _apply_generator(
    problem: Problem,
    params: Any,
    state: TrainState,
    x: Array,
    batch: Batch,
    *,
    train: bool = True,
) -> tuple[Any, Any]:
    """The generator's maps, and its updated statistics."""
    config = problem.config
    dtype = jnp.dtype(config.precision)

    def call(network: Any, maps: Array) -> Any:
        if not config.model.conditions:
            return network(maps, config.model.templates)
        return _maps_of_garments(problem, network, maps, batch, dtype)

    return _apply_network(
        problem.generator,
        params,
        state.generator_rest,
        x,
        dtype=dtype,
        train=train and not config.learned,
        call=call,
    )


def _where_finite(finite: Array, new: Any, old: Any) -> Any:
    """The new statistics if the batch was finite, else the old ones."""
    return jax.tree.map(lambda a, b: jnp.where(finite, a, b), new, old)


def _update(tx: optax.GradientTransformation, grads: Any, state: Any, params: Any) -> Any:
    # optax raises floats to integer powers, which strict promotion forbids.
    with jax.numpy_dtype_promotion("standard"):
        return tx.update(grads, state, params)
