"""The training loop: resumable, logged, and ending in a predictor."""

import json
import pathlib
import time
from collections.abc import Callable, Sequence as Items

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from ..body import load_body
from ..data import Sequence
from ..errors import FormatError, PhysXNetError
from ..files import whole_file
from ..garment import template
from ..models import ModelConfig, Normalisation, Predictor, Surface, make_surface
from ..uv import Atlas, garment_map_rows, make_atlas
from ._batches import (
    Frames,
    batch_indices,
    load_frames,
    measure_normalisation,
    take,
    target_offsets,
)
from ._checkpoint import Checkpoints, config_json
from ._config import TrainConfig
from ._step import ClothTables, TrainState, make_step


def prepare_surface(model: ModelConfig) -> tuple[Atlas, Surface, dict[str, ClothTables]]:
    """Atlas, texels and target tables of a model's templates on the default body."""
    body = load_body()
    rest = body.rest_vertices(body.default_shape())
    atlas = make_atlas(model.resolution)
    garments = {t: template(t) for t in model.templates}  # pyright: ignore[reportArgumentType]
    rows = {t: garment_map_rows(atlas, body, rest, g) for t, g in garments.items()}
    surface = make_surface(atlas, body, rest, {t: r.valid for t, r in rows.items()})
    tables = {
        t: ClothTables(
            rows[t],
            garments[t].rest_vertices(rest),
            garments[t].skin,
            surface.rest_dress if t == "dress" else surface.rest,
            surface.weights,
        )
        for t in model.templates
    }
    return atlas, surface, tables


def train(
    config: TrainConfig,
    sequences: Items[Sequence],
    folder: str | pathlib.Path,
    *,
    steps: int | None = None,
    report: Callable[[int, int, dict[str, float]], None] | None = None,
) -> Predictor:
    """Trains a network, or goes on where the run in a folder stopped.

    Args:
        config: The run.
        sequences: What to learn from.
        folder: Checkpoints and ``metrics.jsonl`` go here.
        steps: Stop after this many steps in all instead of all epochs (the learning
            rate still follows the full length).
        report: Called with steps done, steps in all and the newest metrics.

    Returns:
        The trained predictor.

    Raises:
        PhysXNetError: Too many updates in a row that aren't finite.
    """
    folder = pathlib.Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    body = load_body()
    rest = body.rest_vertices(body.default_shape())
    atlas, surface, tables = prepare_surface(config.model)
    garments = {t: template(t) for t in config.model.templates}  # pyright: ignore[reportArgumentType]
    frames = load_frames(sequences, garments, body, rest, config.model.family)
    normalisation = _normalisation(config, frames, surface, tables)
    per_epoch = max(len(frames) // config.batch, 1)
    total = per_epoch * config.epochs
    stop = total if steps is None else min(steps, total)
    state, step, graph = make_step(config, atlas, surface, normalisation, tables, frames.fps, total)
    _same_run(folder / "config.json", config_json(config, frames.identity))
    checkpoints = Checkpoints(folder / "checkpoints")
    restored = checkpoints.latest(state)
    state = state if restored is None else restored
    done = int(state.step)
    key = jax.random.key(config.seed)
    began = time.perf_counter()
    try:
        with (folder / "metrics.jsonl").open("a") as log:
            while done < stop:
                index = batch_indices(len(frames), config.batch, config.seed, done)
                state, metrics = step(state, take(frames, index), jax.random.fold_in(key, done))
                done += 1
                skipped = max(
                    int(state.generator_opt.notfinite_count),
                    int(state.discriminator_opt.notfinite_count),
                )
                if skipped >= config.max_skipped:
                    raise PhysXNetError(
                        f"step {done}: {skipped} updates in a row were not finite. Lower the"
                        " learning rate or look for NaN in the data."
                    )
                if done % 20 == 0 or done == stop:
                    values = {k: float(v) for k, v in metrics.items()}
                    values |= {"step": done, "seconds": time.perf_counter() - began}
                    log.write(json.dumps(values) + "\n")
                    log.flush()
                    if report is not None:
                        report(done, stop, values)
                if done % config.checkpoint_every == 0:
                    checkpoints.save(state, {"step": done})
    finally:
        if restored is None or int(restored.step) != int(state.step):
            checkpoints.save(state, {"step": int(state.step)})
        checkpoints.close()
    return make_predictor(config.model, atlas, surface, normalisation, state, graph)


def _same_run(path: pathlib.Path, text: str) -> None:
    """Notes what a run is, or refuses to go on with another one in its folder."""
    if path.is_file():
        before, now = json.loads(path.read_text()), json.loads(text)
        changed = [k for k in now if before.get(k) != now[k]]
        if changed:
            raise PhysXNetError(
                f"{path.parent}: the run there has another {', '.join(changed)}. Choose"
                " another folder or delete it."
            )
        return
    with whole_file(path) as part:
        part.write_text(text)


def make_predictor(
    model: ModelConfig,
    atlas: Atlas,
    surface: Surface,
    normalisation: Normalisation,
    state: TrainState,
    graph: nnx.GraphDef,
) -> Predictor:
    """The predictor of a training state."""
    network = nnx.merge(graph, state.generator, state.generator_rest, copy=True)
    network.eval()
    graph, values = nnx.split(network)
    return Predictor(atlas, surface, normalisation, values, graph, model)


def _normalisation(
    config: TrainConfig, frames: Frames, surface: Surface, tables: dict[str, ClothTables]
) -> Normalisation:
    rng = np.random.default_rng(config.seed)
    offsets = {}
    for t, c in tables.items():
        good = np.flatnonzero(frames.usable[t])
        if len(good) == 0:
            raise FormatError(
                f"no usable sequence for '{t}': simulate it, or drop it from the templates."
            )
        pick = rng.choice(good, min(32, len(good)), replace=False)
        meters = target_offsets(
            jnp.asarray(frames.targets[t][pick]),
            c.to_cloth,
            c.rest,
            c.skin,
            c.anchor,
            c.anchor_weights,
            jnp.asarray(frames.rotations[pick, -1]),
            jnp.asarray(frames.translations[pick, -1]),
            config.model.family,
        )
        offsets[t] = meters[:, np.asarray(surface.valid[t])]
    return measure_normalisation(frames, surface, offsets, seed=config.seed)
