"""What a network should minimise: the same decoder, data and steps under each loss.

Command: python experiments/losses.py --data runs/clothes/default
         --weights runs/small/weights (default), --steps 800 (default), --templates dress (default)
Cost:    about 40 minutes a template on two cores; goes on where it was stopped.
Result:  experiments/results/losses.json and .md: each default garment's decoder goes on from the
         weights, on its simulations of the training actions. On the twelve test actions:
         RMSE, folds over the simulation's, wrinkle error, distance of spectra, 99 % of tension and
         jerk over the simulation's.
         vertices: L1 at vertices. patches: half of it at means over patches, the shipped recipe.
         potential: means alone, and the simulator's incremental potential for the rest.
         patches+potential: both errors and a little of the potential.
         patches+elastic: both errors and the elastic part of it, which needs no frame before; once
         more with a third of its weight.
         adversarial: L1 at vertices and the paper's discriminator, which sees maps of cloth cast
         to the texels, and the encoder's features in place of maps of motion.
"""

import argparse
import dataclasses
import functools
import json
import pathlib
import statistics
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx
from jaxtyping import Array, Float
from rich.console import Console
from rich.progress import track

from physxnet_jax.body import load_body
from physxnet_jax.data import Sequence, list_entries
from physxnet_jax.dressing import AdaptConfig, Inference
from physxnet_jax.dressing._adapt_task import (
    Frames,
    Task,
    encode,
    lift_energy,
    make_task,
    mean_errors,
    mean_potential,
    place_maps,
    predict_maps,
)
from physxnet_jax.evaluation import likeness, machine, network, skinning
from physxnet_jax.files import atomic_write, write_json
from physxnet_jax.garment import DEFAULT_KINDS
from physxnet_jax.geometry import polar_rotation
from physxnet_jax.models import Discriminator, Predictor, load_predictor
from physxnet_jax.simulation import (
    PRESETS,
    Assembly,
    ElasticTables,
    Scene,
    elastic_tables,
    make_system,
    prepare_scene,
    standard_effects,
)
from physxnet_jax.training import adversarial_loss, discriminator_loss, soft_labels
from physxnet_jax.uv import Transference, garment_map_rows

RESULTS = pathlib.Path(__file__).parent / "results"
# Frames of each action that are learned from: features of more don't fit in memory.
FRAMES = 160
# Weight of L1 beside the discriminator's answer, relative to the scale of maps: the paper's.
L1_WEIGHT = 100.0
# Weights of the potential, of `adapt`.
ALONE, BESIDE = 0.002, 0.0003
ELASTIC = {"patches+elastic": 0.0003, "patches+elastic, a third": 0.0001}
KINDS = ("vertices", "patches", "potential", "patches+potential", *ELASTIC, "adversarial")
RATE = 1e-3


def sequences(data: str, split: str, template: str) -> list[Sequence]:
    """The actions of a split in a default garment, worn alone."""
    wear = (DEFAULT_KINDS[template],)
    found = [e for e in list_entries(data, split) if e.outfit and e.outfit.wear == wear]
    return [e.read() for e in found]


@jax.jit
def local_offsets(skin: Array, rotations: Array, offsets: Array) -> Array:
    """Offsets in the frames of the vertices, as networks of the local family predict them [m]."""
    blend = jnp.einsum("vj,fjab->fvab", skin, rotations)
    return jnp.einsum("fvba,fvb->fva", jax.vmap(polar_rotation)(blend), offsets)


def data_of(task: Task, params: Any, found: list[Sequence], template: str) -> list[Frames]:
    """Features and targets of every action [m]."""
    body = load_body()
    rest = body.rest_vertices(body.default_shape())
    out = []
    for s in track(found, description="features"):
        frames = encode(task, params, s.motion, body, rest)
        cloth = skinning()(s.motion, s.clothing(template)).positions + s.offsets[template]
        frames = dataclasses.replace(frames, target=np.asarray(cloth, np.float32))
        out.append(frames.take(slice(0, FRAMES)))
    return out


def judged(
    task: Task, rows: Transference, maps: Array, frames: Frames
) -> tuple[Float[Array, "n h w c"], Float[Array, "n h w 3"], Float[Array, "n h w 3"]]:
    """What the discriminator sees: motion, simulated maps and predicted ones."""
    predictor, bound = task.predictor, task.bound
    skinned = place_maps(task, jnp.zeros_like(maps), frames)
    local = local_offsets(bound.skin, frames.rotations, frames.target - skinned)
    texels = jax.vmap(lambda x: rows @ x)(local) / predictor.normalisation.offset[bound.template]
    seen = rows.valid[None, :, None]
    real = predictor.atlas.to_map(jnp.where(seen, texels, 0.0))
    fake = predictor.atlas.to_map(jnp.where(seen, predictor.atlas.from_map(maps), 0.0))
    motion = frames.features[0].astype(jnp.float32)
    motion = jax.image.resize(motion, (*maps.shape[:3], motion.shape[3]), "nearest")
    return motion, real, fake


def judge(graph: Any, state: Any, motion: Array, maps: Array) -> tuple[Array, Any]:
    """The discriminator's logits, and its state with new statistics."""
    critic = nnx.merge(graph, state, copy=True)
    critic.train()
    with jax.numpy_dtype_promotion("standard"):
        logits = critic(motion, maps)
    return logits, nnx.state(critic)


def loss_of(
    kind: str,
    task: Task,
    rows: Transference,
    elastic: tuple[ElasticTables, ...],
    critic: Any,
    graph: Any,
    params: Any,
    frames: Frames,
) -> Float[Array, ""]:
    maps = predict_maps(task, params, frames)
    x = place_maps(task, maps, frames)
    vertices, patches = mean_errors(task, x - frames.target)
    if kind == "vertices":
        return vertices
    if kind == "patches":
        return 0.5 * (vertices + patches)
    if kind == "adversarial":
        # `mean_errors` is relative to 1 cm, the paper's L1 to the scale of the maps.
        scale = 100.0 * task.predictor.normalisation.offset[task.bound.template]
        motion, _, fake = judged(task, rows, maps, frames)
        logits, _ = judge(graph, critic, motion, fake)
        return vertices + scale / L1_WEIGHT * adversarial_loss(logits)
    if kind in ELASTIC:
        (tables,) = elastic
        energy = jnp.mean(jax.vmap(tables.energy)(x)) / lift_energy(task)
        return 0.5 * (vertices + patches) + ELASTIC[kind] * energy
    physics = mean_potential(task, x, frames) / lift_energy(task)
    if kind == "potential":
        return patches + ALONE * physics
    return 0.5 * (vertices + patches) + BESIDE * physics


def critic_loss(
    task: Task, rows: Transference, graph: Any, critic: Any, params: Any, frames: Frames, key: Array
) -> tuple[Float[Array, ""], Any]:
    """Equation 1 of the paper, and the discriminator with new statistics."""
    maps = jax.lax.stop_gradient(predict_maps(task, params, frames))
    motion, real, fake = judged(task, rows, maps, frames)
    said_real, critic = judge(graph, critic, motion, real)
    said_fake, critic = judge(graph, critic, motion, fake)
    k_real, k_fake = jax.random.split(key)
    loss = discriminator_loss(
        said_real,
        said_fake,
        soft_labels(k_real, said_real.shape, real=True),
        soft_labels(k_fake, said_fake.shape, real=False),
    )
    return loss, critic


def learn(
    kind: str,
    task: Task,
    rows: Transference,
    elastic: tuple[ElasticTables, ...],
    params: Any,
    clips: list[Frames],
    steps: int,
) -> Any:
    """The decoder's parameters after so many steps of a loss."""
    config = task.config
    room = np.array([len(c.target) - config.frames + 1 for c in clips])
    optimizer = optax.apply_if_finite(optax.adam(optax.cosine_decay_schedule(RATE, steps)), steps)
    channels = clips[0].features[0].shape[-1] + 3
    graph, critic = nnx.split(Discriminator(channels, width=16, rngs=nnx.Rngs(0)))
    opponent = optax.adam(2e-4, b1=0.5)
    memory, critic_memory = optimizer.init(params), opponent.init(critic)

    @jax.jit
    def step(params: Any, memory: Any, critic: Any, critic_memory: Any, frames: Any, key: Any):
        call = functools.partial(loss_of, kind, task, rows, elastic, critic, graph)
        slopes = jax.grad(lambda p: call(p, frames))(params)
        with jax.numpy_dtype_promotion("standard"):
            changes, memory = optimizer.update(slopes, memory, params)
        if kind == "adversarial":
            call = functools.partial(
                critic_loss, task, rows, graph, params=params, frames=frames, key=key
            )
            slopes, critic_new = jax.grad(lambda c: call(critic=c), has_aux=True)(critic)
            with jax.numpy_dtype_promotion("standard"):
                moves, critic_memory = opponent.update(slopes, critic_memory, critic)
            # Statistics have no slope, so that their moves are zero.
            critic = optax.apply_updates(critic_new, moves)
        return optax.apply_updates(params, changes), memory, critic, critic_memory

    for k in track(range(steps), description=kind):
        # A stream of each step's own: every loss sees the same windows.
        rng = np.random.default_rng((config.seed, k))
        taken = []
        for c in rng.choice(len(clips), config.windows, p=room / room.sum()):
            start = rng.integers(room[c])
            taken.append(clips[c].take(slice(start, start + config.frames)))
        frames = jax.tree.map(lambda *x: jnp.asarray(np.concatenate(x)), *taken)
        params, memory, critic, critic_memory = step(
            params, memory, critic, critic_memory, frames, jax.random.key(k)
        )
    return params


def measure(
    predictor: Predictor, assembly: Assembly, found: list[Sequence], template: str
) -> dict[str, float]:
    """Means over the test actions of the network alone."""
    method = network(Inference(weights=predictor, strain_iterations=0, collisions=False))
    rows = []
    for s in track(found, description="test actions"):
        worn = s.clothing(template)
        truth = skinning()(s.motion, worn).positions + s.offsets[template]
        cloth = method(s.motion, worn).positions
        rows.append(dataclasses.asdict(likeness(assembly, cloth, truth, fps=s.motion.fps)))
    return {k: statistics.fmean(r[k] for r in rows) for k in rows[0]}


def table(rows: list[dict]) -> str:
    lines = [
        "| garment | loss | RMSE, mm | folds | wrinkle error, ° | spectrum | tension | jerk |",
        "|---" * 8 + "|",
    ]
    for r in rows:
        lines.append(
            f"| {DEFAULT_KINDS[r['template']]} | {r['loss']} | {r['rmse_mm']:.1f} |"
            f" {r['folds']:.2f} | {r['wrinkle_deg']:.1f} | {r['spectrum']:.2f} |"
            f" {r['tension']:.2f} | {r['jerk']:.2f} |"
        )
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--data", required=True)
    parser.add_argument("--weights", default="runs/small/weights")
    parser.add_argument("--steps", type=int, default=800)
    parser.add_argument("--templates", nargs="+", choices=DEFAULT_KINDS, default=["dress"])
    parser.add_argument("--out", type=pathlib.Path, default=RESULTS / "losses.json")
    options = parser.parse_args()
    path, settings = options.out, {"weights": options.weights, "steps": options.steps}
    stored = json.loads(path.read_text()) if path.is_file() else {**settings, "rows": []}
    if {k: stored[k] for k in settings} != settings:
        raise SystemExit(f"{path} is of other settings; remove it, or choose another --out.")
    rows: list[dict] = stored["rows"]

    def add(template: str, kind: str, seconds: float, found: dict[str, float]) -> None:
        rows.append({"template": template, "loss": kind, "seconds": seconds, **found})
        write_json(path, {**settings, "machine": machine(), "rows": rows})

    console, body, predictor = Console(), load_body(), load_predictor(options.weights)
    rest = body.rest_vertices(body.default_shape())
    for template in options.templates:
        known = {r["loss"] for r in rows if r["template"] == template}
        if not {"at the start", *KINDS} - known:
            continue
        found = sequences(options.data, "train", template)
        tests = sequences(options.data, "test", template)
        worn = found[0].garment(template)
        scene = prepare_scene(Scene((worn,), standard_effects((worn,))))
        physics = make_system(scene, PRESETS["standard"])
        task, first = make_task(predictor, body, rest, worn, physics, AdaptConfig(), True)
        rows_of_map = garment_map_rows(predictor.atlas, body, rest, worn)
        elastic = (jax.tree.map(lambda x: x[0], elastic_tables([worn], [None])),)
        if "at the start" not in known:
            add(template, "at the start", 0.0, measure(predictor, scene.assembly, tests, template))
        clips = data_of(task, first, found, template)
        for kind in (k for k in KINDS if k not in known):
            began = time.perf_counter()
            params = learn(kind, task, rows_of_map, elastic, first, clips, options.steps)
            seconds = time.perf_counter() - began
            state = nnx.merge_state(params, task.others)
            changed = dataclasses.replace(predictor, state=state)
            add(template, kind, seconds, measure(changed, scene.assembly, tests, template))
    with atomic_write(path.with_suffix(".md")) as file:
        file.write_text(table(rows))
    console.print(table(rows), markup=False, highlight=False, soft_wrap=True)


if __name__ == "__main__":
    main()
