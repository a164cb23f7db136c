"""Finds a pose from clothes alone: gradient descent through the dressing.

Command: python experiments/fit_pose.py
Cost:    about two minutes on two cores.
Result:  the loss (mean squared vertex distance of a dressed top and trousers) falls by
         at least 90 %; the gradient agrees with central differences. Printed, and
         written to experiments/results/fit_pose.json.

A person stands in the air with bent arms and legs; only the clothes are seen. Starting
from hanging limbs, Adam recovers the turns of shoulders, elbows, hips and knees.
"""

import json
import pathlib

import jax
import jax.numpy as jnp
import numpy as np
import optax
from rich.console import Console

import physxnet_jax as px
from physxnet_jax.geometry import quaternion_from_axis_angle, quaternion_multiply

OUT = pathlib.Path("experiments/results/fit_pose.json")
JOINTS = [f"{s}{n}" for s in ("Left", "Right") for n in ("Arm", "ForeArm", "UpLeg", "Leg")]
STEPS = 80


def main() -> None:
    console = Console()
    body = px.load_body()
    rest = body.rest_vertices(body.default_shape())
    predictor = px.load_predictor()
    wearables = []
    for name in ("top", "bottom"):
        garment = px.template(name)
        tied = px.bind(predictor.atlas, body, rest, garment, predictor.surface.valid[name])
        wearables.append(px.make_wearable(body, rest, garment, tied))
    index = jnp.asarray([body.joint(n) for n in JOINTS])
    base, root = body.a_pose(), jnp.zeros((3,))

    def clothes(turns: jax.Array) -> tuple[jax.Array, ...]:
        moved = quaternion_multiply(quaternion_from_axis_angle(turns), base[index])
        world, shift = body.transforms(rest, base.at[index].set(moved), root)
        # One pose held still: four copies stand for the frames before it.
        frames = (pad[None] for pad in (world, shift))
        return px.dress_frames(
            predictor, wearables, *(px.pad_clip(x, predictor.config.inputs) for x in frames), 30.0
        )

    rng = np.random.default_rng(0)
    target = clothes(jnp.asarray(rng.normal(0, 0.5, (len(JOINTS), 3)), jnp.float32))

    @jax.jit
    def loss(turns: jax.Array) -> jax.Array:
        pairs = zip(clothes(turns), target, strict=True)
        return sum(jnp.mean(jnp.sum((a - b) ** 2, axis=-1)) for a, b in pairs)

    value_and_grad = jax.jit(jax.value_and_grad(loss))
    turns = jnp.zeros((len(JOINTS), 3))
    first, gradient = value_and_grad(turns)
    worst, step = 0.0, 3e-3
    for k in range(len(JOINTS)):
        d = jnp.zeros_like(turns).at[k, k % 3].set(step)
        difference = float(loss(turns + d) - loss(turns - d)) / (2 * step)
        gap = abs(difference - float(gradient[k, k % 3])) / float(jnp.abs(gradient).max())
        worst = max(worst, gap)
    console.print(f"largest gap to central differences: {100 * worst:.2f} % of the gradient")
    optimiser = optax.adam(0.05)
    state = optimiser.init(turns)
    for k in range(STEPS):
        value, gradient = value_and_grad(turns)
        updates, state = optimiser.update(gradient, state)
        turns = optax.apply_updates(turns, updates)
        if k % 10 == 0:
            console.print(f"step {k:3}  RMS distance {1e3 * float(value) ** 0.5:7.2f} mm")
    last = float(loss(turns))
    console.print(
        f"loss {float(first):.3e} -> {last:.3e}: {100 * (1 - last / float(first)):.2f} % less"
    )
    result = {
        "first": float(first),
        "last": last,
        "reduction": 1 - last / float(first),
        "gradient_gap": worst,
        "steps": STEPS,
    }
    OUT.parent.mkdir(parents=True, exist_ok=True)
    OUT.write_text(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
