"""The table of training speed compares like with like."""

import pathlib
import runpy

import jax
import numpy as np
from flax import nnx

from physxnet_jax.models import Up

MADE = runpy.run_path(str(pathlib.Path(__file__).parents[2] / "experiments/bench_training.py"))


def test_plain_transposed_convolution_matches_the_up_layer():
    for norm in (True, False):
        layer = Up(5, 3, norm=norm, rngs=nnx.Rngs(0))
        x = jax.random.normal(jax.random.key(1), (2, 6, 8, 5))
        np.testing.assert_allclose(
            np.asarray(MADE["plain_transposed"](layer, x)), np.asarray(layer(x)), atol=1e-5
        )
