"""A custom network, loss and optimizer: `python examples/07_custom_network.py`."""

import tempfile
import time

import jax.numpy as jnp
import optax
from flax import nnx

import physxnet_jax as px
from physxnet_jax.data import Sequence
from physxnet_jax.models import ModelConfig
from physxnet_jax.training import TrainConfig, train
from physxnet_jax.viewer import render_preview


class Small(nnx.Module):
    def __init__(self, inputs, templates, rngs):
        wide, self.templates = nnx.Conv(inputs, 16, (3, 3), rngs=rngs), templates
        last = nnx.Conv(16, 3 * len(templates), (3, 3), rngs=rngs)
        self.layers = nnx.Sequential(wide, nnx.relu, last)

    def __call__(self, x, templates):
        maps = jnp.split(self.layers(x), len(self.templates), axis=-1)
        return {t: m for t, m in zip(self.templates, maps) if t in templates}


def huber(x):
    return jnp.mean(optax.losses.huber_loss(x.texels, x.target) * x.valid[None, :, None])


began = time.perf_counter()
plain = px.Inference(collisions=False)
cloth = px.dress("walk", ["bottom"], method="simulate", frames=60).garments[0].positions
skin = px.dress("walk", ["bottom"], method="lbs", inference=plain, frames=60).garments[0].positions
walk = px.load_motion("walk", fps=30)
walk = px.Motion(walk.rotations[:60], walk.root[:60], walk.fps, "walk")
good = {"bottom": {"finite": True, "worst": {}}}
model = ModelConfig(resolution=32, templates=("bottom",))
config = TrainConfig(model=model, epochs=5, batch=4, adversarial=False)
predictor = train(
    config,
    [Sequence("walk", "train", walk, {"bottom": cloth - skin}, good)],
    tempfile.mkdtemp(),
    network=Small(model.inputs.channels, model.templates, nnx.Rngs(0)),
    loss=huber,
    optimizer=optax.adamw(3e-3),
)
worn = px.dress(
    "walk", ["bottom"], method="network", inference=px.Inference(weights=predictor), frames=60
)
gap = jnp.linalg.norm(worn.garments[0].positions - cloth, axis=-1)
print(f"{1e3 * float(jnp.sqrt(jnp.mean(gap**2))):.1f} mm from the simulation")
print("wrote", render_preview("out/custom.png", worn.meshes, worn.fps, strip=4))
print(f"{time.perf_counter() - began:.0f} s in all, compilation included")
