"""Does a network that sees its own earlier answer come nearer to the simulation?

Command: python experiments/previous_offset.py --data runs/ours
Cost:    about ten minutes on two cores; goes on where it was stopped.
Result:  experiments/results/previous_offset.json and .md, shown in docs/reproduction.md: RMSE
         over vertices of the twelve test actions, beside skinning.

Both networks are `base` of ablations.py with nine channels more: the offsets of all three
garments `LAG` frames before. One always finds zeros there. The other learns from what it
answers itself (half of the time), from the simulation, and from zeros, as at a clip's start;
what it answers itself follows from the simulation twice as long before. It is then asked in
two ways: with its own earlier answers, as it would have to be used, and with the simulation's,
which tells what a perfect memory would be worth.
"""

import argparse
import dataclasses
import functools
import json
import pathlib
import statistics
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx
from jaxtyping import Array
from rich.progress import Progress

from physxnet_jax.body import load_body
from physxnet_jax.data import QUANTUM, Sequence, list_sequences, read_sequence
from physxnet_jax.evaluation import skinning, vertex_error
from physxnet_jax.files import whole_file
from physxnet_jax.garment import TEMPLATES, template
from physxnet_jax.io import load_predictor
from physxnet_jax.models import (
    Generator,
    Inputs,
    ModelConfig,
    Normalisation,
    Predictor,
    Surface,
    apply_offsets,
    clip_features,
    normalise,
)
from physxnet_jax.training import (
    Checkpoints,
    ClothTables,
    Frames,
    TrainConfig,
    TrainState,
    batch_indices,
    load_frames,
    make_optimiser,
    masked_l1,
    prepare_surface,
    take,
    usable_garment,
    vertex_loss,
)
from physxnet_jax.uv import Atlas

RESULTS = pathlib.Path(__file__).parent / "results"
CONFIG = TrainConfig(
    model=ModelConfig(Inputs("local"), resolution=64, width=16),
    epochs=3,
    batch=8,
    learning_rate=3e-3,
    schedule="cosine",
    adversarial=False,
    vertex_share=0.7,
)
# Just before the five poses that the network sees anyway.
LAG = 5
# How often what was before is its own answer, the simulation's, or unknown.
SHARES = (0.5, 0.3, 0.2)
SAVE_EVERY = 200


@dataclasses.dataclass(frozen=True)
class Setting:
    """What both runs share."""

    atlas: Atlas
    surface: Surface
    tables: dict[str, ClothTables]
    normalisation: Normalisation
    fps: float

    def features(self, rotations: Array, translations: Array) -> Array:
        """Normalised motion of each window's last frame, shape [batch, texels, channels]."""
        seen = jax.vmap(clip_features, in_axes=(None, None, 0, 0, None, None))(
            self.surface.rest,
            self.surface.weights,
            rotations,
            translations,
            self.fps,
            CONFIG.model.inputs,
        )
        return normalise(seen[:, 0], self.normalisation, CONFIG.model.inputs)

    def wanted(self, batch: dict[str, Array], name: str) -> Array:
        """A garment's simulated offsets at texels over their scale; zero where unknown."""
        meters = batch[f"target_{name}"].astype(jnp.float32) * QUANTUM
        counts = batch[f"weight_{name}"][:, None, None]
        covered = self.surface.valid[name].astype(jnp.float32)[None, :, None]
        offsets = self.tables[name].to_cloth @ meters
        return offsets * (counts * covered / self.normalisation.offset[name])

    def memory(self, batch: dict[str, Array]) -> Array:
        """The simulated offsets of all garments, shape [batch, texels, 9]."""
        return jnp.concatenate([self.wanted(batch, t) for t in TEMPLATES], axis=-1)


def earlier(index: np.ndarray, first: np.ndarray, frames: int) -> tuple[np.ndarray, np.ndarray]:
    """Frames some time before, in the same clip, and whether there are such."""
    at = index - frames
    return np.maximum(at, first[index]), (at >= first[index]).astype(np.float32)


def learn(
    setting: Setting,
    frames: Frames,
    first: np.ndarray,
    remembers: bool,
    folder: str,
    bars: Progress,
) -> Predictor:
    """Trains one network, or goes on where the run stopped."""
    atlas, surface = setting.atlas, setting.surface
    network = Generator(
        CONFIG.model.inputs.channels + 3 * len(TEMPLATES),
        TEMPLATES,
        width=CONFIG.model.width,
        rngs=nnx.Rngs(CONFIG.seed),
    )
    graph, params, rest = nnx.split(network, nnx.Param, ...)
    total = len(frames) // CONFIG.batch * CONFIG.epochs
    tx = make_optimiser(CONFIG, CONFIG.learning_rate, total)

    def answer(params: Any, rest: Any, x: Array, memory: Array) -> tuple[dict[str, Array], Any]:
        net = nnx.merge(graph, params, rest, copy=True)
        net.train()
        maps = net(atlas.to_map(jnp.concatenate([x, memory], axis=-1)), TEMPLATES)
        texels = {
            t: atlas.from_map(m) * surface.valid[t].astype(jnp.float32)[None, :, None]
            for t, m in maps.items()
        }
        return texels, nnx.state(net, nnx.Not(nnx.Param))

    @jax.jit
    def step(
        state: TrainState, now: dict, before: dict, long_before: dict, kind: Array
    ) -> tuple[TrainState, Array]:
        memory = setting.memory(before)
        if remembers:
            there = setting.features(before["rotations"], before["translations"])
            own, _ = answer(
                state.generator, state.generator_rest, there, setting.memory(long_before)
            )
            own = jax.lax.stop_gradient(jnp.concatenate([own[t] for t in TEMPLATES], axis=-1))
            kind = jnp.where(before["known"] > 0, kind, 2)[:, None, None]
            memory = jnp.where(kind == 0, own, jnp.where(kind == 1, memory, 0.0))
        else:
            memory = jnp.zeros_like(memory)
        x = setting.features(now["rotations"], now["translations"])

        def loss(params: Any) -> tuple[Array, Any]:
            texels, rest = answer(params, state.generator_rest, x, memory)
            value = jnp.zeros(())
            for t in TEMPLATES:
                table, weight = setting.tables[t], now[f"weight_{t}"]
                at_texels = masked_l1(texels[t], setting.wanted(now, t), surface.valid[t], weight)
                wanted = now[f"target_{t}"].astype(jnp.float32) * QUANTUM
                at_vertices = vertex_loss(
                    table.wearable.sample(texels[t]),
                    wanted / setting.normalisation.offset[t],
                    table.edges,
                    weight,
                    masked_l1,
                    0.0,
                )
                share = CONFIG.vertex_share
                value += ((1.0 - share) * at_texels + share * at_vertices) / len(TEMPLATES)
            return CONFIG.l1_weight * value, rest

        (value, rest), slopes = jax.value_and_grad(loss, has_aux=True)(state.generator)
        with jax.numpy_dtype_promotion("standard"):
            updates, opt = tx.update(slopes, state.generator_opt, state.generator)
        params = optax.apply_updates(state.generator, updates)
        new = dataclasses.replace(
            state, generator=params, generator_rest=rest, generator_opt=opt, step=state.step + 1
        )
        return new, value

    state = TrainState(params, rest, {}, {}, tx.init(params), {}, jnp.zeros((), jnp.int32))
    checkpoints = Checkpoints(folder)
    state = checkpoints.latest(state) or state
    bar = bars.add_task("own answers" if remembers else "zeros", total=total)
    while (done := int(state.step)) < total:
        index = batch_indices(len(frames), CONFIG.batch, CONFIG.seed, done)
        before, known = earlier(index, first, LAG)
        long_before, long_known = earlier(index, first, 2 * LAG)
        rng = np.random.default_rng([CONFIG.seed, done])
        batches = [take(frames, index), take(frames, before), take(frames, long_before)]
        batches[1]["known"] = known
        for t in TEMPLATES:
            batches[2][f"weight_{t}"] *= long_known
        state, value = step(state, *batches, rng.choice(3, CONFIG.batch, p=SHARES))
        bars.update(bar, completed=done + 1, description=f"loss {float(value):.2f}")
        if (done + 1) % SAVE_EVERY == 0 or done + 1 == total:
            checkpoints.save(state, {"step": done + 1})
    checkpoints.close()
    network = nnx.merge(graph, state.generator, state.generator_rest, copy=True)
    network.eval()
    graph, values = nnx.split(network)
    return Predictor(atlas, surface, setting.normalisation, values, graph, CONFIG.model)


@functools.partial(jax.jit, static_argnames="fps")
def dressed(
    predictor: Predictor,
    tables: dict[str, ClothTables],
    rotations: Array,
    translations: Array,
    memory: Array,
    fps: float,
) -> tuple[dict[str, Array], Array]:
    """Cloth [m] of some frames, and what to remember of them."""
    setting = Setting(predictor.atlas, predictor.surface, tables, predictor.normalisation, fps)
    x = setting.features(rotations, translations)
    offsets = predictor.from_features(jnp.concatenate([x, memory], axis=-1), TEMPLATES)
    cloth = {
        t: jax.vmap(lambda r, s, o, t=t: apply_offsets(tables[t].wearable, r, s, o, "local"))(
            rotations[:, -1], translations[:, -1], offsets[t]
        )
        for t in TEMPLATES
    }
    scaled = [offsets[t] / predictor.normalisation.offset[t] for t in TEMPLATES]
    return cloth, jnp.concatenate(scaled, axis=-1)


def follow(predictor: Predictor, setting: Setting, clip: Frames, ask: str) -> dict[str, np.ndarray]:
    """Cloth of a clip; `ask` tells what is remembered: zeros, own or simulated."""
    count = len(clip)
    texels = setting.surface.rest.shape[0]
    memory = jnp.zeros((LAG, texels, 3 * len(TEMPLATES)))
    parts: list[dict[str, np.ndarray]] = []
    for start in range(0, count, LAG):
        index = np.minimum(np.arange(start, start + LAG), count - 1)
        if ask == "simulated" and start:
            told = take(clip, index - LAG)
            memory = setting.memory({k: jnp.asarray(v) for k, v in told.items()})
        cloth, answered = dressed(
            predictor,
            setting.tables,
            jnp.asarray(clip.rotations[index]),
            jnp.asarray(clip.translations[index]),
            memory,
            setting.fps,
        )
        memory = answered if ask == "own" else memory
        parts.append({t: np.asarray(v) for t, v in cloth.items()})
    return {t: np.concatenate([p[t] for p in parts])[:count] for t in TEMPLATES}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", default="runs/ours")
    parser.add_argument("--runs", default="runs/previous_offset", help="where the runs are kept")
    words = parser.parse_args()
    path = RESULTS / "previous_offset.json"
    rows = json.loads(path.read_text()) if path.is_file() else []
    known = [read_sequence(f) for f in list_sequences(words.data, "train")]
    tests = [read_sequence(f) for f in list_sequences(words.data, "test")]
    if len(known) < 16 or not tests:
        raise SystemExit(f"{words.data}: not built (whole); see docs/reproduction.md.")
    atlas, surface, tables = prepare_surface(CONFIG.model)
    body = load_body()
    garments = {t: template(t) for t in TEMPLATES}
    load = functools.partial(
        load_frames,
        garments=garments,
        body=body,
        rest=body.rest_vertices(body.default_shape()),
        inputs=CONFIG.model.inputs,
    )
    frames = load(known)
    lengths = [s.motion.num_frames for s in known]
    first = np.repeat(np.cumsum([0, *lengths[:-1]]), lengths)
    scales = load_predictor("local").normalisation
    setting = Setting(atlas, surface, tables, scales, frames.fps)
    with Progress() as bars:
        for name, asks in (("zeros", ("zeros",)), ("own answers", ("own", "simulated"))):
            if any(r["learned from"] == name for r in rows):
                continue
            folder = str(pathlib.Path(words.runs) / name.replace(" ", "_"))
            predictor = learn(setting, frames, first, name != "zeros", folder, bars)
            for ask in asks:
                errors: dict[str, list[float]] = {t: [] for t in TEMPLATES}
                skinned: dict[str, list[float]] = {t: [] for t in TEMPLATES}
                for s in bars.track(tests, description=ask):
                    measure(errors, skinned, s, follow(predictor, setting, load([s]), ask))
                rows += [
                    {
                        "learned from": name,
                        "asked with": ask,
                        "template": t,
                        "actions": len(errors[t]),
                        "rmse_vertices_mm": round(statistics.fmean(errors[t]), 2),
                        "skinning_mm": round(statistics.fmean(skinned[t]), 2),
                    }
                    for t in TEMPLATES
                ]
            with whole_file(path) as part:
                part.write_text(json.dumps(rows, indent=1) + "\n")
    with whole_file(path.with_suffix(".md")) as part:
        part.write_text(table(rows) + "\n")
    print(table(rows))  # noqa: T201


def measure(
    errors: dict[str, list[float]],
    skinned: dict[str, list[float]],
    sequence: Sequence,
    cloth: dict[str, np.ndarray],
) -> None:
    for t in TEMPLATES:
        if t not in sequence.offsets or not usable_garment(sequence.meta[t]):
            continue
        plain = skinning()(sequence.motion, t).positions
        reference = plain + sequence.offsets[t]
        errors[t].append(vertex_error(cloth[t], reference).rmse_mm)
        skinned[t].append(vertex_error(plain, reference).rmse_mm)


def table(rows: list[dict]) -> str:
    """A line for each way of asking, skinning last."""
    lines = [
        "| learned from | asked with | top, mm | bottom, mm | dress, mm |",
        "|---|---|---|---|---|",
    ]
    ways = dict.fromkeys((r["learned from"], r["asked with"]) for r in rows)
    for way in ways:
        cells = [r for r in rows if (r["learned from"], r["asked with"]) == way]
        shown = " | ".join(f"{r['rmse_vertices_mm']:.1f}" for r in cells)
        lines.append(f"| {way[0]} | {way[1]} | {shown} |")
    plain = " | ".join(f"{r['skinning_mm']:.1f}" for r in rows[: len(TEMPLATES)])
    lines.append(f"| skinning | | {plain} |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
