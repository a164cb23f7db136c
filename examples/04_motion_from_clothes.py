"""Through the clothes by gradient: which knee made this hem?

    python examples/04_motion_from_clothes.py

The left knee's bend is hidden; only the trousers' vertices are seen. Gradient descent
through the network finds it again.
"""

import time

import jax
import jax.numpy as jnp
import numpy as np
import optax

import physxnet_jax as px
from physxnet_jax.io import AnimatedMesh
from physxnet_jax.viewer import render_preview

began = time.perf_counter()
dresser = px.make_dresser(["trousers"], inference=px.Inference(weights="small"))
body = px.load_body()
knee = body.joint_names.index("LeftLeg")
motion = px.load_motion("balance", fps=30)
pose, root = motion.rotations[:1], motion.root[:1]


def bent(angle):
    """The pose with the knee turned by an angle about its own X axis [rad]."""
    turn = jnp.array([jnp.cos(angle / 2), jnp.sin(angle / 2), 0.0, 0.0])
    w, x, y, z = pose[0, knee]
    a, b = turn[0], turn[1]
    turned = jnp.stack([w * a - x * b, w * b + x * a, y * a + z * b, z * a - y * b])
    return pose.at[0, knee].set(turned)


def trousers(angle):
    return px.clothe(dresser, bent(angle), root, fps=30.0)["trousers"]


seen = trousers(jnp.float32(0.6))


def loss(angle):
    return 1e6 * jnp.mean((trousers(angle) - seen) ** 2)


angle = jnp.float32(0.1)
optimizer = optax.adam(optax.cosine_decay_schedule(0.05, 120))
state = optimizer.init(angle)
step = jax.jit(jax.value_and_grad(loss))
for k in range(120):
    value, slope = step(angle)
    change, state = optimizer.update(slope, state)
    angle = optax.apply_updates(angle, change)
    if k % 20 == 0:
        print(f"step {k:2d}: {float(value):10.3f} mm^2, knee at {float(angle):.3f} rad")
print(f"found {float(angle):.3f} rad; hidden were 0.600")
faces = np.asarray(dresser.garments[0].mesh.faces)
three = np.stack([seen[0], trousers(jnp.float32(0.1))[0], trousers(angle)[0]])
picture = [AnimatedMesh("trousers", three, faces)]
print("wrote", render_preview("out/knee.png", picture, 30.0, strip=3), "(seen, at first, found)")
print(f"{time.perf_counter() - began:.0f} s in all, compilation included")
