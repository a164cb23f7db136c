"""Values that are computed once."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physxnet_jax.geometry import materialize

X = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)


def _gathered(keep):
    def program(x, index):
        return keep(jnp.exp(x) * x)[index]

    return program


def test_arrays_come_back_as_they_are_whatever_they_hold():
    x = np.array([np.inf, np.nan, -0.0, 1e-40, 3.0], np.float32)
    for start in range(len(x)):
        there = np.roll(x, start)
        kept = np.asarray(jax.jit(materialize)(there))
        np.testing.assert_array_equal(kept.view(np.int32), there.view(np.int32))
    assert materialize({"none": jnp.zeros((0, 3))})["none"].shape == (0, 3)


def test_derivatives_are_those_of_the_identity():
    def loss(x, keep):
        return jnp.sum(jnp.sin(keep(x * x)))

    expected = jax.grad(loss)(X, lambda x: x)
    np.testing.assert_allclose(jax.jit(jax.grad(loss), static_argnums=1)(X, materialize), expected)
    _, slope = jax.jvp(lambda x: materialize(2.0 * x), (X,), (X,))
    np.testing.assert_array_equal(slope, 2.0 * X)
    batched = jax.vmap(jax.grad(lambda x: loss(x, materialize)))(X)
    np.testing.assert_allclose(batched, expected, rtol=1e-6)


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="only processors need it")
@pytest.mark.parametrize(("keep", "fused"), [(materialize, False), (lambda x: x, True)])
def test_what_a_gather_reads_is_not_computed_within_it(keep, fused):
    index = np.zeros(400, np.int32)
    text = jax.jit(_gathered(keep)).lower(X[:, 0], index).compile().as_text()
    gathers = [part for part in text.split("\n\n") if " gather(" in part]
    assert gathers
    assert any(" multiply(" in part for part in gathers) == fused
