"""Training with a custom network, loss and optimizer, and wearing the result."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax import nnx

from physxnet_jax.data import Sequence, take
from physxnet_jax.dressing import Inference, dress, make_dresser
from physxnet_jax.errors import WeightsError
from physxnet_jax.evaluation import network
from physxnet_jax.garment import template
from physxnet_jax.models import (
    ModelConfig,
    fold_batch_norm,
    load_predictor,
    make_generator,
    save_predictor,
)
from physxnet_jax.motion import load_motion
from physxnet_jax.training import TrainConfig, make_problem, train, train_step
from physxnet_jax.training._data import load_data

CONFIG = TrainConfig(
    model=ModelConfig(resolution=32, width=4, templates=("bottom",)),
    epochs=1,
    batch=4,
    adversarial=False,
)


class Tiny(nnx.Module):
    """One convolution with the generator's signature."""

    def __init__(self, rngs):
        self.conv = nnx.Conv(CONFIG.model.inputs.channels, 3, (1, 1), rngs=rngs)

    def __call__(self, x, templates):
        return {t: self.conv(x) for t in templates}


@pytest.fixture(scope="module")
def walk():
    motion = load_motion("walk", fps=30.0)
    motion = dataclasses.replace(motion, rotations=motion.rotations[:12], root=motion.root[:12])
    cloth = np.full((12, template("bottom").num_vertices, 3), 0.01, np.float32)
    return Sequence(
        "walk", "train", motion, {"bottom": cloth}, {"bottom": {"finite": True, "worst": {}}}
    )


@pytest.fixture(scope="module")
def trained(walk, tmp_path_factory):
    seen = []

    def loss(x):
        seen.append(x.texels.shape)
        return jnp.mean(jnp.abs(x.texels - x.target))

    folder = tmp_path_factory.mktemp("run")
    predictor = train(
        CONFIG,
        [walk],
        folder,
        network=Tiny(nnx.Rngs(0)),
        loss=loss,
        optimizer=optax.sgd(0.1),
    )
    assert seen, "the loss was not called"
    return predictor, folder


@pytest.mark.nightly
def test_custom_network_trains_and_dresses(trained):
    predictor, folder = trained
    lines = [json.loads(x) for x in (folder / "metrics.jsonl").read_text().splitlines()]
    assert lines[-1]["step"] == 3 and lines[-1]["skipped"] == 0
    # Folding passes it through, and every entry point takes it.
    assert isinstance(nnx.merge(fold_batch_norm(predictor).graph, predictor.state), Tiny)
    inference = Inference(weights=predictor, collisions=False)
    assert make_dresser(["bottom"], inference=inference).predictor is not None
    clip = dress(
        "walk",
        ["bottom"],
        method="network",
        inference=inference,
        frames=3,
        include_body=False,
    )
    assert np.isfinite(clip.garments[0].positions).all()
    motion = load_motion("walk", fps=30.0)
    motion = dataclasses.replace(motion, rotations=motion.rotations[:3], root=motion.root[:3])
    assert np.isfinite(network(inference)(motion, "bottom").positions).all()


@pytest.mark.release
def test_custom_network_is_saved_and_loaded(trained, tmp_path):
    predictor, _ = trained
    save_predictor(tmp_path / "w", predictor, name="w")
    assert json.loads((tmp_path / "w/card.json").read_text())["network"] == "Tiny"
    with pytest.raises(WeightsError, match="custom network Tiny"):
        load_predictor(tmp_path / "w")
    again = load_predictor(tmp_path / "w", network=Tiny(nnx.Rngs(1)))
    x = jnp.ones((1, predictor.texel_points.rest.shape[0], CONFIG.model.inputs.channels))
    a, b = (p.from_features(x, ("bottom",))["bottom"] for p in (predictor, again))
    np.testing.assert_allclose(a, b, atol=2e-4)


@pytest.mark.release
def test_train_step_is_compiled_once_per_problem(walk):
    data = load_data(CONFIG, [walk])
    problem, state = make_problem(
        CONFIG,
        data.atlas,
        data.texel_points,
        data.normalisation,
        data.tables,
        fps=30.0,
        steps=10,
        network=make_generator(CONFIG.model),
    )
    before = train_step._cache_size()
    for k in range(3):
        batch = take(data.frames.first(), np.arange(4) + k)
        state, metrics = train_step(problem, state, batch, jax.random.key(k))
    assert train_step._cache_size() == before + 1
    assert int(state.step) == 3 and np.isfinite(float(metrics["loss"]))
