"""The simulator as a layer: an effect of one's own, and a material found from motion.

    python examples/06_differentiable_simulation.py

A square of cloth hangs by one edge in a wind that the package doesn't have. Only its motion
is seen; how stiff it bends is found by gradient descent through the simulation.
"""

import dataclasses
import time

import jax
import jax.numpy as jnp
import numpy as np
import optax

import physxnet_jax as px
from physxnet_jax.garment import Fabric, square_sheet
from physxnet_jax.io import AnimatedMesh
from physxnet_jax.simulation import (
    XPBD,
    Effect,
    Prepared,
    Scene,
    advance,
    make_system,
    prepare_scene,
    start_state,
)
from physxnet_jax.simulation.effects import Bend, Gravity, Pin, Stretch
from physxnet_jax.viewer import render_preview


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class _Sway(Prepared):
    strength: jax.Array

    def begin(self, base, start, end, clock, memory):
        return clock.time

    def accelerate(self, velocity, context, h):
        push = self.strength * jnp.sin(2 * jnp.pi * context)
        return velocity.at[:, 2].add(push * h)


@dataclasses.dataclass(frozen=True)
class Sway(Effect):
    """Everything is pushed to and fro once a second, by so many m/s^2."""

    strength: float = 6.0

    def prepare(self, assembly, inverse_mass):
        """Nothing depends on the garments."""
        return _Sway(jnp.float32(self.strength))


began = time.perf_counter()
FPS, FRAMES = 30.0, 15
sheet = square_sheet(7, 0.2, pinned=np.arange(7), fabric=Fabric(stretch=500.0, bend=2e-4))
scene = prepare_scene(Scene((sheet,), (Gravity(), Sway(), Stretch(), Bend(), Pin())))
solver = XPBD(8, 2)
system = make_system(scene, solver)
body = px.load_body()
rest = body.rest_vertices(body.default_shape())
# Frames, people side by side, joints: one person who stands still.
pose = jnp.repeat(body.a_pose()[None, None], FRAMES + 1, axis=0)
root = jnp.repeat(body.joint_positions(rest)[0][:1][None], FRAMES + 1, axis=0)
cloth = jnp.asarray(sheet.mesh.vertices)[:, :, None]


def motion(log_factor):
    """Positions of the sheet, its bending stiffness multiplied by a factor."""
    changed = system.rescaled(bend=jnp.exp(log_factor))
    state = start_state(changed, cloth, solver=solver, fps=FPS)
    return advance(changed, state, pose, root, solver=solver, fps=FPS)[1]


seen = motion(jnp.log(jnp.float32(3.0)))


@jax.jit
@jax.value_and_grad
def loss(log_factor):
    return 1e6 * jnp.mean((motion(log_factor) - seen) ** 2)


log_factor = jnp.float32(0.0)
optimizer = optax.adam(optax.cosine_decay_schedule(0.2, 60))
state = optimizer.init(log_factor)
for k in range(60):
    value, slope = loss(log_factor)
    change, state = optimizer.update(slope, state)
    log_factor = optax.apply_updates(log_factor, change)
    if k % 12 == 0:
        print(f"step {k:2d}: {float(value):9.4f} mm^2, {float(jnp.exp(log_factor)):.2f} times")
print(f"found {float(jnp.exp(log_factor)):.2f} times the stiffness; hidden were 3.00")
picture = [AnimatedMesh("sheet", np.asarray(seen[..., 0]), np.asarray(sheet.mesh.faces))]
print("wrote", render_preview("out/sheet.png", picture, FPS, strip=5))
print(f"{time.perf_counter() - began:.0f} s in all, compilation included")
