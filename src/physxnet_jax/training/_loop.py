"""The training loop: resumable, logged, and ending in a predictor."""

import itertools
import json
import pathlib
import time
from collections.abc import Callable, Sequence as Items
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from ..body import load_body
from ..data import Sequence, mirrored_sequence
from ..errors import FormatError, PhysXNetError
from ..files import append_line, whole_file
from ..garment import template
from ..geometry import mesh_edges
from ..models import ModelConfig, Normalisation, Predictor, Surface, make_surface, make_wearable
from ..uv import Atlas, bind, garment_map_rows, make_atlas
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
from ._step import ClothTables, Steps, TrainState, make_step
from ._watch import METRICS, Board, Players, Validation, read_metrics


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
            g.rest_vertices(rest),
            g.skin,
            surface.rest_dress if t == "dress" else surface.rest,
            surface.weights,
            make_wearable(body, rest, g, bind(atlas, body, rest, g, rows[t].valid)),
            jnp.asarray(mesh_edges(np.asarray(g.mesh.faces)).vertices),
        )
        for t, g in garments.items()
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
        FormatError: Nothing usable to learn from or to validate on.
    """
    folder = pathlib.Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    body = load_body()
    rest = body.rest_vertices(body.default_shape())
    atlas, surface, tables = prepare_surface(config.model)
    garments = {t: template(t) for t in config.model.templates}  # pyright: ignore[reportArgumentType]
    held = _held_out(config, sequences)
    used = [s for s in sequences if s.name not in config.validation]
    # One at a time: each is as large as its original.
    images = (mirrored_sequence(body, s) for s in used if config.mirror)
    frames = load_frames(itertools.chain(used, images), garments, body, rest, config.model.inputs)
    unseen = load_frames(held, garments, body, rest, config.model.inputs) if held else None
    if unseen is not None and not any(x.any() for x in unseen.usable.values()):
        raise FormatError(
            f"no usable cloth in {', '.join(config.validation)}: validate on another action."
        )
    normalisation = _normalisation(config, frames, surface, tables)
    per_epoch = max(len(frames) // config.batch, 1)
    total = per_epoch * config.epochs
    stop = total if steps is None else min(steps, total)
    run = make_step(config, atlas, surface, normalisation, tables, frames.fps, total)
    _same_run(folder / "config.json", config_json(config, frames.identity))
    checkpoints = Checkpoints(folder / "checkpoints")
    best_kept = Checkpoints(folder / "best", keep=1)
    restored = checkpoints.latest(run.first)
    state = run.first if restored is None else restored
    done = int(state.step)
    best_kept.forget_after(done)
    noted = read_metrics(folder)
    watch = Validation(noted, done, config.patience)
    players = Players(noted, done)
    key = jax.random.key(config.seed)
    board = Board(folder)
    began = time.perf_counter()

    def note(values: dict[str, float]) -> None:
        values |= {"step": done, "seconds": round(time.perf_counter() - began, 3)}
        append_line(folder / METRICS, values)
        board.write(values, done)
        if report is not None:
            report(done, stop, values)

    try:
        while done < stop and not watch.exhausted:
            index = batch_indices(len(frames), config.batch, config.seed, done)
            state, metrics = run.step(state, take(frames, index), jax.random.fold_in(key, done))
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
            last = done == stop
            if done % 20 == 0 or last:
                values = {k: float(v) for k, v in metrics.items()}
                note(values | players.update(values))
            # On schedule alone: a run that is stopped on the way has to be the same run.
            if unseen is not None and (done % config.validate_every == 0 or done == total):
                losses, shown = _validate(config, run, state, unseen)
                if watch.update(losses["validation_mm"]):
                    best_kept.save(state, {"step": done, **losses})
                note(losses)
                board.show(shown, done)
            if done % config.checkpoint_every == 0:
                checkpoints.save(state, {"step": done})
    finally:
        board.close()
        if restored is None or int(restored.step) != int(state.step):
            checkpoints.save(state, {"step": int(state.step)})
        checkpoints.close()
    best = best_kept.latest(run.first) if unseen is not None else None
    best_kept.close()
    chosen = state if best is None else best
    return make_predictor(config.model, atlas, surface, normalisation, chosen, run.graph)


def _held_out(config: TrainConfig, sequences: Items[Sequence]) -> list[Sequence]:
    names = {s.name for s in sequences}
    missing = [n for n in config.validation if n not in names]
    if missing:
        raise FormatError(
            f"validation actions {', '.join(missing)} aren't among the sequences:"
            f" {', '.join(sorted(names)) or 'none'}."
        )
    return [s for s in sequences if s.name in config.validation]


def _validate(
    config: TrainConfig, run: Steps, state: TrainState, frames: Frames
) -> tuple[dict[str, float], dict[str, tuple[np.ndarray, np.ndarray]]]:
    """Mean absolute errors [mm] on what isn't trained on, and maps of the middle."""
    sums = dict.fromkeys(config.model.templates, 0.0)
    weights = dict.fromkeys(config.model.templates, 0.0)
    shown: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    # Neighbouring frames tell the same.
    order = np.arange(0, len(frames), 3)
    for start in range(0, len(order), config.batch):
        real = order[start : start + config.batch]
        batch = take(frames, np.resize(real, config.batch))
        for t in config.model.templates:
            # What fills up the last batch counts for nothing.
            batch[f"weight_{t}"][len(real) :] = 0.0
        losses, maps = run.look(state, batch)
        for t, value in losses.items():
            count = float(batch[f"weight_{t}"].sum())
            sums[t] += count * float(value)
            weights[t] += count
        if start <= len(order) // 2 < start + config.batch:
            shown = {t: (np.asarray(a[0]), np.asarray(b[0])) for t, (a, b) in maps.items()}
    # What of it came off the body tells nothing.
    each = {f"validation_mm_{t}": sums[t] / weights[t] for t in sums if weights[t]}
    return {"validation_mm": float(np.mean(list(each.values()))), **each}, shown


def _same_run(path: pathlib.Path, text: str) -> None:
    """Notes what a run is, or refuses to go on with another one in its folder."""
    if path.is_file():
        # What a run begun by an earlier version doesn't say was as it is by default.
        before = _filled(json.loads(path.read_text()), json.loads(config_json(TrainConfig(), "")))
        now = json.loads(text)
        changed = [k for k in now if before.get(k) != now[k]]
        if changed:
            raise PhysXNetError(
                f"{path.parent}: the run there has another {', '.join(changed)}. Choose"
                " another folder or delete it."
            )
        return
    with whole_file(path) as part:
        part.write_text(text)


def _filled(told: dict[str, Any], usual: dict[str, Any]) -> dict[str, Any]:
    """Settings, with what isn't among them as it is by default."""
    inner = {k: _filled(told.get(k, {}), v) for k, v in usual.items() if isinstance(v, dict)}
    return {**usual, **told, **inner}


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
