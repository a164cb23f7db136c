"""Errors in closed form."""

import jaxtyping
import numpy as np
import pytest

from physxnet_jax.evaluation import vertex_error


def test_vertex_error_of_a_known_shift_is_exact():
    x = np.random.default_rng(0).normal(size=(3, 7, 3)).astype(np.float32)
    e = vertex_error(x + np.array([0.003, 0.0, 0.004], np.float32), x)
    assert e.rmse_mm == pytest.approx(5.0, rel=1e-3) and e.mse_mm2 == pytest.approx(25.0, rel=1e-3)
    assert e.mean_mm == pytest.approx(5.0, rel=1e-3) and e.max_mm == pytest.approx(5.0, rel=1e-3)
    half = x.copy()
    half[..., :3, 0] += 0.002
    e = vertex_error(half, x)
    assert e.mse_mm2 == pytest.approx(4.0 * 3 / 7, rel=1e-3), "three of seven vertices"
    assert e.max_mm == pytest.approx(2.0, rel=1e-3) and vertex_error(x, x).max_mm == 0.0
    # The shape check of the test suite comes first; outside it the ValueError speaks.
    with pytest.raises((ValueError, jaxtyping.TypeCheckError)):
        vertex_error(x[:, :2], x)
    with pytest.raises(ValueError, match="at least one vertex"):
        vertex_error(x[:0], x[:0])
