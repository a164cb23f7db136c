"""What memory is worth: a decoder that is given its own answer for the frame before.

Command: python experiments/memory.py --train runs/clothes/dress --test runs/clothes/default
         --garment dress (default) --weights base (default) --steps 500 (default)
Cost:    an hour and a half on one core; goes on where it was stopped (in runs/memory).
Result:  experiments/results/memory.json and .md: RMSE [mm] at the vertices over the test actions of
         skinning, of the weights as they are, and of their decoder after further training with and
         without memory, each carried through whole clips.

The state is the offsets of the vertices in the skin's own frames and their change from frame to
frame, as maps, with a channel for whether there is one. It enters the decoder like the maps of a
garment: scales and shifts of hidden layers, at first none. Every sample of a batch walks through
one clip after another, eight frames a step: from the simulated cloth in half of the steps, from its
own answers in the others, both with 3 mm of noise, and without state in one step in ten.
"""

import argparse
import dataclasses
import json
import pathlib
import statistics
from collections.abc import Iterator, Sequence as Items
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx
from jaxtyping import Array, Float
from rich.console import Console
from rich.progress import track

from history import errors
from physxnet_jax.body import load_body
from physxnet_jax.data import (
    QUANTIZATION_STEP,
    Outfit,
    Sequence,
    is_trainable,
    list_sequences,
    load_frames,
    make_wardrobe,
    mirrored_sequence,
    read_sequence,
)
from physxnet_jax.evaluation import machine
from physxnet_jax.files import atomic_write, write_json
from physxnet_jax.garment import DEFAULT_KINDS
from physxnet_jax.models import Modulation, Predictor, clip_features, load_predictor, normalise
from physxnet_jax.models._networks import Decoder, Modulator
from physxnet_jax.uv import bind, condition_maps

RESULTS = pathlib.Path(__file__).parent / "results"
STREAMS, FRAMES, CHUNK = 6, 8, 16
RATE, NOISE, FORGET = 2e-4, 0.003, 0.1
STATE_CHANNELS = 7
# Changes from one frame to the next are small beside offsets.
CHANGE = 10.0

console = Console(soft_wrap=True)


class Remembering(nnx.Module):
    """A decoder, and what turns the state into scales and shifts of its hidden layers."""

    def __init__(self, decoder: Decoder, width: int, *, rngs: nnx.Rngs) -> None:
        self.decoder = decoder
        widths = [4 * width, 2 * width, width, max(width // 2, 4)]
        self.memory = Modulator(STATE_CHANNELS, widths, rngs=rngs)

    def __call__(self, features: Items[Array], garment: Modulation, state: Array) -> Array:
        """A map of normalised offsets."""
        known = jax.tree.map(lambda a, b: a + b, garment, self.memory(state))
        return self.decoder(features, known)


@dataclasses.dataclass(frozen=True)
class Clip:
    """What the encoder sees in a clip, and the cloth in the frames of the skin [0.1 mm]."""

    action: str
    features: tuple[np.ndarray, ...]
    target: np.ndarray


@dataclasses.dataclass(frozen=True)
class Setting:
    """All that stays the same: the garment as the network has it, and how maps reach vertices."""

    predictor: Predictor
    binding: Any
    modulation: Modulation
    valid: Array
    scale: Array
    graph: Any
    fixed: Any

    def vertices(self, maps: Float[Array, "batch h w 3"]) -> Float[Array, "batch vertices 3"]:
        """Normalised offsets at the vertices."""
        texels = self.predictor.atlas.from_map(maps)
        return self.binding.sample(jnp.where(self.valid[None, :, None], texels, 0.0))

    def map_of(self, values: Float[Array, "batch vertices 3"]) -> Float[Array, "batch h w 3"]:
        """Means of vertex values at the texels that the vertices sample; zero at others."""
        index, weight = self.binding.texel.ravel(), self.binding.weight.ravel()
        size, k = len(self.valid), self.binding.texel.shape[1]
        total = jnp.zeros((size,)).at[index].add(weight)
        every = jnp.repeat(values, k, axis=1) * weight[None, :, None]
        sums = jnp.zeros((len(values), size, 3)).at[:, index].add(every)
        return self.predictor.atlas.to_map(sums / jnp.maximum(total, 1e-3)[None, :, None])


def prepare(weights: str, name: str) -> tuple[Setting, Any]:
    """The setting, and the parameters from which training begins."""
    predictor, body = load_predictor(weights), load_body()
    rest = body.rest_vertices(body.default_shape())
    garment = Outfit(wear=(DEFAULT_KINDS[name],)).garments()[name]
    valid = predictor.texel_points.valid[name]
    binding = bind(garment, atlas=predictor.atlas, body=body, rest=rest, valid=valid)
    maps = condition_maps(predictor.atlas, body, rest, garment, binding, predictor.config.fabrics)
    network = nnx.merge(predictor.graph, predictor.state)
    network.eval()
    model = Remembering(network.decoders[name], predictor.config.width, rngs=nnx.Rngs(0))
    graph, params, fixed = nnx.split(model, nnx.Param, ...)
    setting = Setting(
        predictor,
        binding,
        predictor.modulation(name, maps),
        valid,
        predictor.normalisation.offset[name],
        graph,
        fixed,
    )
    return setting, params


def clips(setting: Setting, sequences: Iterator[Sequence], name: str) -> list[Clip]:
    """What is learned from or tested on, encoded once: the encoder doesn't learn."""
    predictor, body = setting.predictor, load_body()
    inputs, points = predictor.config.inputs, predictor.texel_points

    @jax.jit
    def encode(rotations: Array, translations: Array) -> list[Array]:
        network = nnx.merge(predictor.graph, predictor.state)
        network.eval()
        found = jax.vmap(clip_features, in_axes=(None, None, 0, 0, None, None))(
            points.rest, points.weights, rotations, translations, 30.0, inputs
        )
        x = normalise(found[:, 0], predictor.normalisation, inputs)
        out = network.encode(predictor.motion_atlas.to_map(x))
        whole = name == "dress"
        return [f if whole else f[:, : f.shape[1] * 2 // 3] for f in out]

    out = []
    for s in sequences:
        seen = make_wardrobe([s.outfit], (name,))
        f = load_frames([s], seen, body, window=inputs.window, local=True)
        count = len(f)
        padded = np.minimum(np.arange(-(-count // CHUNK) * CHUNK), count - 1)
        parts = [
            [np.asarray(x, np.float16) for x in encode(f.rotations[i], f.translations[i])]
            for i in padded.reshape(-1, CHUNK)
        ]
        levels = tuple(np.concatenate(x)[:count] for x in zip(*parts, strict=True))
        target = f.targets[name]
        if not f.usable[name].all():
            target = exact(s, name)
        out.append(Clip(s.motion.name, levels, target))
    return out


def exact(sequence: Sequence, name: str) -> np.ndarray:
    """Cloth in the frames of the skin [0.1 mm], of clips that training leaves out."""
    zero = np.zeros_like(np.asarray(sequence.offsets[name], np.float32))
    skinned, _ = errors(sequence, name, zero)
    return np.round(-skinned / QUANTIZATION_STEP).astype(np.int16)


def roll(
    setting: Setting, params: Any, features: Any, start: tuple[Array, Array, Array], remember: bool
) -> tuple[tuple[Array, Array, Array], Array]:
    """Normalised offsets at the vertices over successive frames, and the state after them.

    The state: the last offsets, their change, and whether there are any.
    """

    def step(
        carry: tuple[Array, Array, Array], seen: list[Array]
    ) -> tuple[tuple[Array, Array, Array], Array]:
        before, change, known = carry
        model = nnx.merge(setting.graph, params, setting.fixed)
        maps = [setting.map_of(x) for x in (before, CHANGE * change)]
        every = jnp.broadcast_to(known[:, None, None, None], (*maps[0].shape[:3], 1))
        state = jnp.concatenate([*maps, every], axis=-1)
        state = state if remember else jnp.zeros_like(state)
        rows = setting.modulation[-1][0].shape[1] * 2
        m = model([f.astype(jnp.float32) for f in seen], setting.modulation, state[:, :rows])
        m = jnp.pad(m, ((0, 0), (0, maps[0].shape[1] - m.shape[1]), (0, 0), (0, 0)))
        found = setting.vertices(m)
        kept = jnp.clip(found, -3.0, 3.0)
        moved = jnp.where(known[:, None, None] > 0, kept - before, 0.0)
        return (kept, moved, jnp.ones_like(known)), found

    return jax.lax.scan(jax.checkpoint(step), start, features)


def empty(setting: Setting, count: int) -> tuple[Array, Array, Array]:
    """No state."""
    zero = jnp.zeros((count, setting.binding.texel.shape[0], 3))
    return zero, zero, jnp.zeros((count,))


def plan(lengths: list[int], steps: int, seed: int) -> Iterator[list[tuple[int, int, bool, bool]]]:
    """For each step and sample the clip, the first frame, and from what it begins.

    That is nothing, the simulated cloth, or else its own answer.
    """
    rng, coin = np.random.default_rng(seed), np.random.default_rng(seed + 1)
    where: list[tuple[int, int]] = [(-1, 0)] * STREAMS
    for _ in range(steps):
        row = []
        for k, (clip, frame) in enumerate(where):
            fresh = rng.random() < FORGET
            if clip < 0 or frame + FRAMES > lengths[clip]:
                # The first clips begin anywhere, so that samples don't go in step.
                first = clip < 0
                clip = int(rng.integers(len(lengths)))
                frame = int(rng.integers(lengths[clip] - FRAMES)) if first else 0
                fresh = True
            row.append((clip, frame, fresh, not fresh and frame > 1 and bool(coin.random() < 0.5)))
            where[k] = (clip, frame + FRAMES)
        yield row


def train(
    setting: Setting,
    params: Any,
    known: list[Clip],
    steps: int,
    folder: pathlib.Path,
    *,
    remember: bool,
    seed: int = 0,
) -> Any:
    """The decoder after further training."""
    schedule = optax.warmup_cosine_decay_schedule(0.0, RATE, min(50, steps // 4), steps)
    tx = optax.adam(schedule)
    structure = jax.tree.structure((params, tx.init(params), empty(setting, STREAMS)))

    @jax.jit
    def learn(
        params: Any,
        opt: Any,
        state: Any,
        features: Any,
        target: Array,
        past: Array,
        begun: Array,
        key: Array,
    ) -> tuple[Any, Any, Any, Array]:
        unit = QUANTIZATION_STEP / setting.scale
        true = past[:, 1] * unit, (past[:, 1] - past[:, 0]) * unit, jnp.ones(len(past))
        fresh, given = jnp.unstack(begun)
        before, change, known = (
            jnp.where(given.reshape(-1, *(1,) * (a.ndim - 1)) > 0, a, b)
            for a, b in zip(true, state, strict=True)
        )
        noise = NOISE / setting.scale * jax.random.normal(key, before.shape)
        kept = (1.0 - fresh) * known
        wide = kept[:, None, None]
        start = (wide * (before + noise), wide * change, kept)

        def loss(p: Any) -> tuple[Array, Any]:
            after, found = roll(setting, p, features, start, remember)
            wanted = target.astype(jnp.float32) * unit
            return jnp.mean(jnp.abs(found - wanted)), after

        (value, after), grads = jax.value_and_grad(loss, has_aux=True)(params)
        with jax.numpy_dtype_promotion("standard"):
            updates, opt = tx.update(grads, opt, params)
        return optax.apply_updates(params, updates), opt, after, value

    opt, state, done = tx.init(params), empty(setting, STREAMS), 0
    saved = folder / f"{'with' if remember else 'without'}.npz"
    if saved.is_file():
        with np.load(saved) as z:
            done = int(z["done"])
            leaves = [jnp.asarray(z[str(k)]) for k in range(structure.num_leaves)]
        params, opt, state = jax.tree.unflatten(structure, leaves)
    losses: list[float] = []
    rows = list(plan([len(c.target) for c in known], steps, seed))
    for k in track(range(done, steps), "with memory" if remember else "without"):
        cut = [(known[c], slice(f, f + FRAMES)) for c, f, *_ in rows[k]]
        features = [
            np.stack([c.features[level][w] for c, w in cut], axis=1)
            for level in range(len(cut[0][0].features))
        ]
        target = np.stack([c.target[w] for c, w in cut], axis=1)
        past = np.stack([known[c].target[[max(f - 2, 0), max(f - 1, 0)]] for c, f, *_ in rows[k]])
        begun = jnp.asarray([[float(n) for *_, n, _ in rows[k]], [float(g) for *_, g in rows[k]]])
        key = jax.random.fold_in(jax.random.key(seed), k)
        params, opt, state, value = learn(
            params, opt, state, features, target, past.astype(np.float32), begun, key
        )
        losses.append(float(value))
        if (k + 1) % 50 == 0 or k + 1 == steps:
            mm = 1e3 * float(setting.scale) * statistics.fmean(losses[-50:])
            console.print(f"{saved.stem} {k + 1}/{steps}: {mm:.2f} mm")
            leaves = jax.tree.leaves((params, opt, state))
            with atomic_write(saved) as file:
                np.savez(file, done=k + 1, **{str(i): x for i, x in enumerate(leaves)})
    return params


def rmse(setting: Setting, params: Any, clip: Clip, run: Any) -> float:
    """Root mean square of vertex distances over a whole clip [mm]."""
    state, total, count = empty(setting, 1), 0.0, len(clip.target)
    padded = np.minimum(np.arange(-(-count // FRAMES) * FRAMES), count - 1)
    for i in padded.reshape(-1, FRAMES):
        state, found = run(params, [f[i][:, None] for f in clip.features], state)
        gap = np.asarray(found)[:, 0] * float(setting.scale) - clip.target[i] * QUANTIZATION_STEP
        new = slice(0, max(0, min(FRAMES, count - int(i[0]))))
        total += float((gap[new].astype(np.float64) ** 2).sum(axis=-1).mean(axis=1).sum())
    return 1e3 * float(np.sqrt(total / count))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--train", action="append", required=True)
    parser.add_argument("--test", required=True)
    parser.add_argument("--garment", default="dress")
    parser.add_argument("--weights", default="base")
    parser.add_argument("--steps", type=int, default=500)
    parser.add_argument("--out", type=pathlib.Path, default=RESULTS / "memory.json")
    options = parser.parse_args()
    name, folder = options.garment, pathlib.Path("runs/memory") / options.garment
    folder.mkdir(parents=True, exist_ok=True)
    setting, params = prepare(options.weights, name)

    def learned() -> Iterator[Sequence]:
        body = load_body()
        for root in options.train:
            for path in track(list_sequences(root), root):
                s = read_sequence(path)
                if name in s.offsets and is_trainable(s, name):
                    yield s
                    yield mirrored_sequence(body, s)

    tested = (
        s for s in map(read_sequence, list_sequences(options.test, "test")) if name in s.offsets
    )
    known = clips(setting, learned(), name)
    after = {
        "further training": train(setting, params, known, options.steps, folder, remember=False),
        "with memory": train(setting, params, known, options.steps, folder, remember=True),
    }
    runs = {
        remember: jax.jit(lambda p, f, s, r=remember: roll(setting, p, f, s, r))
        for remember in (False, True)
    }
    rows = []
    for clip in clips(setting, tested, name):
        skinned = (clip.target * QUANTIZATION_STEP).astype(np.float64)
        row = {"skinning": 1e3 * float(np.sqrt((skinned**2).sum(axis=-1).mean()))}
        row["network"] = rmse(setting, params, clip, runs[False])
        for method, p in after.items():
            row[method] = rmse(setting, p, clip, runs[method == "with memory"])
        rows.append({"garment": name, "action": clip.action, **row})
        console.print(rows[-1])
    record(options.out, options.weights, rows)


def record(out: pathlib.Path, weights: str, rows: list[dict]) -> None:
    """Adds the rows of a garment to the result, and writes the table."""
    old = json.loads(out.read_text())["rows"] if out.is_file() else []
    rows = [r for r in old if r["garment"] != rows[0]["garment"]] + rows
    write_json(out, {"machine": machine(), "weights": weights, "rows": rows})
    columns = [c for c in rows[0] if c not in ("garment", "action")]
    lines = ["| garment | " + " | ".join(f"{c}, mm" for c in columns) + " |"]
    lines.append("|---" * (1 + len(columns)) + "|")
    for name in dict.fromkeys(r["garment"] for r in rows):
        mine = [r for r in rows if r["garment"] == name]
        values = (f"{statistics.fmean(r[c] for r in mine):.1f}" for c in columns)
        lines.append(f"| {name} | " + " | ".join(values) + " |")
    with atomic_write(out.with_suffix(".md")) as file:
        file.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
