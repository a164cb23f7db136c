"""Through the clothes by gradient: which knee made this hem?

    python examples/04_motion_from_clothes.py

The left knee's bend is hidden; only the trousers' vertices are seen. Gradient descent
through the network finds it again.
"""

import jax
import jax.numpy as jnp
import optax

import physxnet_jax as px

dresser = px.make_dresser(["bottom"], inference=px.Inference(weights="nano", strain_iterations=0))
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
    return px.clothe(dresser, bent(angle), root, fps=30.0)["bottom"]


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
