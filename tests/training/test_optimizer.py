"""Muon: orthogonal steps for kernels, Adam's for all else, none from what isn't finite."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optax
import optax.contrib
import pytest

from physxnet_jax.training import (
    TrainConfig,
    make_optimizer,
    orthogonalize_via_newton_schulz,
    scale_by_muon,
)

CONFIG = TrainConfig(optimizer="muon")


def spectrum(matrix):
    return np.linalg.svd(np.asarray(matrix, np.float64), compute_uv=False)


def with_spectrum(rows, values, seed=0):
    rng = np.random.default_rng(seed)
    left = np.linalg.qr(rng.normal(size=(rows, len(values))))[0]
    right = np.linalg.qr(rng.normal(size=(len(values), len(values))))[0]
    return jnp.asarray((left * np.asarray(values)) @ right.T, jnp.float32)


def quintic(s):
    """Five Newton-Schulz steps of a singular value over the root of sums of squares."""
    s = s / np.linalg.norm(s)
    for _ in range(5):
        s = 3.4445 * s - 4.7750 * s**3 + 2.0315 * s**5
    return s


@pytest.mark.parametrize("values", [np.ones(6), np.logspace(0, -3, 12), np.logspace(2, -6, 9)])
def test_newton_schulz_brings_singular_values_near_one(values):
    matrix = with_spectrum(40, values)
    out = np.asarray(orthogonalize_via_newton_schulz(matrix), np.float64)
    left, seen, right = np.linalg.svd(np.asarray(matrix, np.float64), full_matrices=False)
    inside = left.T @ out @ right.T
    np.testing.assert_allclose(np.diag(inside), quintic(seen), atol=2e-3)
    np.testing.assert_allclose(inside - np.diag(np.diag(inside)), 0.0, atol=2e-3)
    # What has any size at all is brought up.
    assert spectrum(out)[seen / np.linalg.norm(seen) > 1 / 500].min() > 0.6
    assert spectrum(out).max() < 1.25


@pytest.mark.parametrize("scale", [1e-30, 1e-12, 1e12, 1e30])
def test_orthogonalization_is_invariant_to_scale(scale):
    matrix = with_spectrum(20, np.linspace(1.0, 0.1, 8))
    plain, scaled = (
        orthogonalize_via_newton_schulz(matrix),
        orthogonalize_via_newton_schulz(matrix * scale),
    )
    np.testing.assert_allclose(np.asarray(plain), np.asarray(scaled), atol=1e-5)


def test_zero_and_rank_one_gradients_are_orthogonalized():
    assert not np.asarray(orthogonalize_via_newton_schulz(jnp.zeros((9, 4)))).any()
    out = orthogonalize_via_newton_schulz(jnp.ones((9, 4)))
    values = spectrum(out)
    assert 0.6 < values[0] < 1.25 and values[1:].max() < 1e-3


@pytest.mark.parametrize("shape", [(4, 4, 3, 8), (1, 1, 4, 12)])
def test_first_muon_step_matches_optax(shape):
    kernel = jax.random.normal(jax.random.key(0), shape)
    ours = scale_by_muon()
    theirs = optax.contrib.muon(
        1.0,
        muon_weight_dimension_numbers=[optax.contrib.MuonDimensionNumbers((0, 1, 2), 3)],
    )
    with jax.numpy_dtype_promotion("standard"):
        a, _ = ours.update([kernel], ours.init([kernel]))
        b, _ = theirs.update([kernel], theirs.init([kernel]), [kernel])
    np.testing.assert_allclose(np.asarray(a[0]), -np.asarray(b[0]), atol=1e-5)


def first_step(gradient_scale=1.0, **rates):
    """Changes by the first step to a kernel, to the one that answers, and to a gain."""
    params = [jnp.zeros((2, 2, 4, 8)), jnp.zeros((2, 2, 4, 3)), jnp.zeros((8,))]
    keys = jax.random.split(jax.random.key(1), 3)
    gradients = [
        gradient_scale * jax.random.normal(k, p.shape) for k, p in zip(keys, params, strict=True)
    ]
    tx = make_optimizer(CONFIG, 1e-3, 100, **rates)
    with jax.numpy_dtype_promotion("standard"):
        updates, state = tx.update(gradients, tx.init(params), params)
    return [np.asarray(u) for u in updates], state


@pytest.mark.release
def test_kernels_use_muon_and_other_parameters_use_adam():
    (kernel, last, gain), _ = first_step(muon_learning_rate=0.02)
    values = spectrum(kernel.reshape(-1, 8))
    assert 0.6 * 0.02 < values.min() and values.max() < 1.25 * 0.02
    for by_adam in (last, gain):
        np.testing.assert_allclose(np.abs(by_adam), 1e-3, rtol=1e-3)
    # Without a rate for kernels: Adam for every number.
    for by_adam in first_step()[0]:
        np.testing.assert_allclose(np.abs(by_adam), 1e-3, rtol=1e-3)


def test_non_finite_steps_are_skipped_and_counted():
    updates, state = first_step(np.nan, muon_learning_rate=0.02)
    assert not any(u.any() for u in updates)
    assert int(state.total_notfinite) == 1
    assert int(first_step(muon_learning_rate=0.02)[1].total_notfinite) == 0


def sizes(config, steps, rate=1e-3):
    """How far each step of an even gradient moves a number."""
    tx = make_optimizer(config, rate, steps)
    params = [jnp.zeros(3)]
    state, out = tx.init(params), []
    with jax.numpy_dtype_promotion("standard"):
        for _ in range(steps):
            updates, state = tx.update([jnp.ones(3)], state, params)
            out.append(float(-updates[0][0]))
    return np.asarray(out)


def test_cosine_schedule_warms_up_and_decays_and_constant_is_constant():
    np.testing.assert_allclose(sizes(TrainConfig(), 100), 1e-3, rtol=1e-3)
    rate = sizes(dataclasses.replace(TrainConfig(), schedule="cosine"), 100)
    assert rate[0] == pytest.approx(5e-4, rel=1e-2) and rate.max() == pytest.approx(1e-3, rel=1e-3)
    assert rate.argmax() == 2 and (np.diff(rate[2:]) < 0).all() and rate[-1] < 1e-5
    assert rate[51] == pytest.approx(5e-4, rel=0.03)


@pytest.mark.parametrize("b1", [0.5, 0.9])
def test_adam_b1_matches_the_configuration(b1):
    config = dataclasses.replace(TrainConfig(), b1=b1)
    ours, theirs = make_optimizer(config, 1e-3, 10), optax.adam(1e-3, b1=b1)
    params = [jnp.zeros(3)]
    a, b = ours.init(params), theirs.init(params)
    with jax.numpy_dtype_promotion("standard"):
        for g in (1.0, -3.0, 0.5):
            x, a = ours.update([jnp.full(3, g)], a, params)
            y, b = theirs.update([jnp.full(3, g)], b, params)
            np.testing.assert_allclose(np.asarray(x[0]), np.asarray(y[0]), rtol=1e-5)
