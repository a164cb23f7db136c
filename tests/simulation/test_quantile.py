"""Quantiles by counting against sorting."""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from physxnet_jax.simulation._quantile import upper_quantile


@pytest.mark.release
@settings(max_examples=30, deadline=None)
@given(
    st.lists(st.floats(width=32, allow_nan=False, allow_infinity=False), min_size=1, max_size=20),
    st.sampled_from([0.0, 0.5, 0.99, 1.0]),
)
def test_quantile_is_a_value_of_the_sorted_list(values, share):
    x = np.asarray(values, np.float32)
    rank = max(1, round(share * (len(x) - 1)) + 1)
    found = np.asarray(upper_quantile(jnp.asarray(x)[:, None], share))[0]
    # Denormals count as zero on CPUs.
    tiny = np.finfo(np.float32).tiny
    assert abs(found - np.sort(x)[rank - 1]) <= tiny


def test_batch_members_do_not_mix_and_nan_is_the_largest():
    x = np.random.default_rng(0).normal(size=(101, 3)).astype(np.float32)
    x[7, 1] = np.nan
    found = np.asarray(upper_quantile(jnp.asarray(x), 1.0))
    assert found[0] == x[:, 0].max() and found[1] == np.inf and found[2] == x[:, 2].max()


def test_float64_is_exact(x64):
    x = np.random.default_rng(1).normal(size=(50, 1))
    assert float(upper_quantile(jnp.asarray(x), 0.5)[0]) == np.sort(x[:, 0])[round(0.5 * 49)]


@pytest.fixture
def x64():
    import jax

    with jax.enable_x64(True):
        yield
