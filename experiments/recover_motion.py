"""Motion recovered from clothed vertices alone, through the network as a layer.

Command: python experiments/recover_motion.py
         --motion walk (a built-in clip or a motion file), --wear top bottom, --frames 12,
         --steps 200, --weights base, --target simulate (or network),
         --out experiments/results/recover_motion.json
Cost:    3 minutes on two cores beside other work.
Result:  recover_motion.json: how far joints are off when clothes are explained by skinning
         alone and by the network, and before. The clothes come from the simulator, which
         neither of them is; with --target network the network explains its own.

Of the pose nothing is given but its first frame, held. Joints beneath the clothes count:
no vertex tells of hands, feet or the head.
"""

import argparse
import functools
import json
import pathlib
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float
from rich.progress import Progress

from physxnet_jax.dressing import Dresser, Inference, clothe, dress, make_dresser
from physxnet_jax.files import atomic_write
from physxnet_jax.garment import skin_garment
from physxnet_jax.geometry import quaternion_from_axis_angle, quaternion_multiply
from physxnet_jax.motion import Motion, load_motion

RESULTS = pathlib.Path(__file__).parent / "results"
COVERED = ("Hips", "LeftUpLeg", "RightUpLeg", "LeftLeg", "RightLeg", "Spine", "Spine1", "LeftArm")
COVERED += ("RightArm", "LeftForeArm", "RightForeArm")
Layer = Callable[[Array, Array], dict[str, Array]]


def recover(
    layer: Layer,
    target: dict[str, Float[Array, "frames vertices 3"]],
    rotations: Float[Array, "frames joints 4"],
    root: Float[Array, "frames 3"],
    *,
    steps: int,
    rate: float = 0.02,
    report: Callable[[int, float], None] | None = None,
) -> tuple[Float[Array, "frames joints 4"], Float[Array, "frames 3"]]:
    """Rotations and root whose clothes lie nearest to the target.

    Args:
        layer: Clothes of rotations and a root, by garment; differentiable.
        target: Vertices wanted [m].
        rotations: Where to start.
        root: Likewise [m].
        steps: Steps of Adam.
        rate: Its rate at first [rad] and [m]; it falls to zero.
        report: Called with steps done and the root mean square distance [m].

    Returns:
        Rotations and root.
    """

    def posed(change: tuple[Array, Array]) -> tuple[Array, Array]:
        turn = quaternion_from_axis_angle(change[0])
        return quaternion_multiply(rotations, turn), root + change[1]

    def loss(change: tuple[Array, Array]) -> Array:
        cloth = layer(*posed(change))
        squares = [jnp.mean(jnp.sum((cloth[n] - x) ** 2, axis=2)) for n, x in target.items()]
        return functools.reduce(jnp.add, squares) / len(squares)

    optimizer = optax.adam(optax.cosine_decay_schedule(rate, steps))

    @jax.jit
    def step(change: tuple[Array, Array], state: optax.OptState) -> tuple:
        value, grads = jax.value_and_grad(loss)(change)
        with jax.numpy_dtype_promotion("standard"):
            updates, state = optimizer.update(grads, state)
        return optax.apply_updates(change, updates), state, value

    change = (jnp.zeros((*rotations.shape[:2], 3)), jnp.zeros_like(root))
    state = optimizer.init(change)
    for k in range(steps):
        change, state, value = step(change, state)
        if report is not None:
            report(k + 1, float(value) ** 0.5)
    return posed(change)


def network_layer(dresser: Dresser, fps: float) -> Layer:
    """Clothes as the network has them."""
    return lambda q, p: clothe(dresser, q, p, fps)


def skinning_layer(dresser: Dresser) -> Layer:
    """Clothes as if glued to the skin."""

    def layer(rotations: Array, root: Array) -> dict[str, Array]:
        transforms = jax.vmap(lambda q, p: dresser.body.transforms(dresser.rest, q, p))
        world, shift = transforms(rotations, root)
        return {
            w.name: jax.vmap(functools.partial(skin_garment, w))(world, shift) for w in dresser.worn
        }

    return layer


def joint_error(dresser: Dresser, a: tuple[Array, Array], b: tuple[Array, Array]) -> float:
    """Mean distance of the joints beneath the clothes, over the frames [m]."""
    body = dresser.body
    names = list(body.joint_names)
    covered = np.array([names.index(n) for n in COVERED])
    at_rest = body.joint_positions(dresser.rest)[0]

    def places(q: Array, p: Array) -> Array:
        world, shift = body.transforms(dresser.rest, q, p)
        return (jnp.einsum("jab,jb->ja", world, at_rest) + shift)[covered]

    gap = jax.vmap(places)(*a) - jax.vmap(places)(*b)
    return float(jnp.mean(jnp.linalg.norm(gap, axis=2)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--motion", default="walk")
    parser.add_argument("--wear", nargs="+", default=["top", "bottom"])
    parser.add_argument("--frames", type=int, default=12)
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--weights", default="base")
    parser.add_argument("--target", choices=("simulate", "network"), default="simulate")
    parser.add_argument("--out", default=str(RESULTS / "recover_motion.json"))
    words = parser.parse_args()
    clip = load_motion(words.motion, fps=30.0)
    motion = Motion(clip.rotations[: words.frames], clip.root[: words.frames], 30.0, clip.name)
    dresser = make_dresser(
        words.wear,
        inference=Inference(weights=words.weights, strain_iterations=0, collisions=False),
    )
    worn = dress(
        motion,
        words.wear,
        method=words.target,
        inference=Inference(weights=words.weights, strain_iterations=0),
    )
    target = {g.name: jnp.asarray(g.positions) for g in worn.garments}
    true = (motion.rotations, motion.root)
    held = (jnp.broadcast_to(true[0][:1], true[0].shape), true[1])
    held = (held[0], jnp.broadcast_to(true[1][:1], true[1].shape))
    row: dict[str, object] = {"motion": clip.name, "frames": words.frames, "wear": words.wear}
    row |= {"target": words.target, "weights": words.weights, "steps": words.steps}
    row["joints_mm_before"] = round(1e3 * joint_error(dresser, held, true), 2)
    layers = {"skinning": skinning_layer(dresser), "network": network_layer(dresser, 30.0)}
    with Progress() as bars:
        for name, layer in layers.items():
            bar = bars.add_task(name, total=words.steps)
            last = [0.0]

            def show(done: int, away: float, bar=bar, name=name, last=last) -> None:
                last[0] = away
                bars.update(bar, completed=done, description=f"{name}: {1e3 * away:.1f} mm")

            found = recover(layer, target, *held, steps=words.steps, report=show)
            row[f"joints_mm_{name}"] = round(1e3 * joint_error(dresser, found, true), 2)
            row[f"cloth_mm_{name}"] = round(1e3 * last[0], 2)
    with atomic_write(pathlib.Path(words.out)) as part:
        part.write_text(json.dumps(row, indent=1) + "\n")
    bars.console.print_json(json.dumps(row))


if __name__ == "__main__":
    main()
