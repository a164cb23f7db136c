"""Teach a packaged network cloth of your own, through the clothes; save it and wear it.

python examples/05_fine_tune.py
"""

import dataclasses
import time

import jax
import jax.numpy as jnp
import optax
from flax import nnx

import physxnet_jax as px
from physxnet_jax.models import save_predictor
from physxnet_jax.viewer import render_columns

began = time.perf_counter()
FRAMES, STEPS = 4, 12
motion = px.load_motion("walk", fps=30)
pose, root = motion.rotations[:FRAMES], motion.root[:FRAMES]
# What to learn: here a simulation; yours may be a capture with the same vertices.
simulated = px.dress(
    "walk", ["bottom"], method="simulate", simulation=px.Simulation(accuracy="draft"), frames=FRAMES
)
truth = jnp.asarray(simulated.garments[0].positions)

# A dresser's network is folded for speed. What learns is the one that was loaded.
known = px.load_predictor("nano")
dresser = px.make_dresser(
    ["bottom"], inference=px.Inference(weights=known, strain_iterations=0, collisions=False)
)
params, statistics = nnx.split_state(known.state, nnx.Param, ...)


def wear(params):
    """The clothes by a network of these parameters; its batch norm stays as it is."""
    state = nnx.merge_state(params, statistics)
    taught = dataclasses.replace(known, state=state, texel_points=dresser.predictor.texel_points)
    worn = dataclasses.replace(dresser, predictor=taught)
    return px.clothe(worn, pose, root, fps=30.0)["bottom"]


def loss(params):
    """Mean square distance [mm^2]."""
    return 1e6 * jnp.mean(jnp.sum((wear(params) - truth) ** 2, axis=-1))


@jax.jit
def step(params, memory):
    """One step of Adam."""
    value, slope = jax.value_and_grad(loss)(params)
    change, memory = optimizer.update(slope, memory)
    return optax.apply_updates(params, change), memory, value


optimizer = optax.adam(1e-3)
memory = optimizer.init(params)
errors = []
for _ in range(STEPS):
    params, memory, value = step(params, memory)
    errors.append(float(value) ** 0.5)
print(f"{errors[0]:.1f} mm before, {errors[-1]:.1f} mm after {STEPS - 1} steps")

state = nnx.merge_state(params, statistics)
save_predictor("mine", dataclasses.replace(known, state=state), name="mine")
clip = px.dress(
    "walk",
    ["bottom"],
    method="network",
    inference=px.Inference(weights="mine", strain_iterations=0, collisions=False),
    frames=FRAMES,
)
off = jnp.sqrt(jnp.mean(jnp.sum((clip.garments[0].positions - truth) ** 2, axis=-1)))
print(f"worn from the folder `mine`: {1e3 * float(off):.1f} mm off")
columns = {"simulation": simulated.meshes, "taught": clip.meshes}
print("wrote", render_columns("out/taught.png", columns, 30.0, strip=2))
print(f"{time.perf_counter() - began:.0f} s in all, compilation included")
