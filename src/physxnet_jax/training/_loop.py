"""The training loop: resumable and logged; the result is a predictor."""

import dataclasses
import json
import math
import pathlib
import time
from collections.abc import Callable, Iterator, Sequence as Items
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx
from jax.sharding import Mesh

from ..data import (
    Batches,
    Entry,
    Frames,
    Sequence,
    Where,
    join_templates,
    take,
)
from ..devices import at_home, make_mesh, own_rows, repeated, split
from ..errors import PhysXNetError
from ..files import append_line, atomic_write, claims
from ..models import Predictor, load_predictor, read_card
from ._checkpoint import Checkpoints, config_json
from ._config import TrainConfig
from ._data import TrainingData, load_data
from ._monitor import METRICS, EarlyStopping, GanMonitor, TensorBoardLogger, read_metrics
from ._problem import Loss, Problem, TrainState, make_problem
from ._step import eval_step, train_step

_Report = Callable[[int, int, dict[str, float]], None]


def _going_on(data: TrainingData, before: Predictor) -> TrainingData:
    """The data at the scales of weights, with the texels of the garments that these have seen."""
    points, old = data.texel_points, before.texel_points.valid
    valid = old | {t: seen | old[t] if t in old else seen for t, seen in points.valid.items()}
    points = dataclasses.replace(points, valid=valid)
    return dataclasses.replace(data, normalisation=before.normalisation, texel_points=points)


# Processes of one run share its folder.
@claims("folder", unless=jax.process_index)
def train(
    config: TrainConfig,
    sequences: Items[Sequence | Where | Entry] | TrainingData,
    folder: str | pathlib.Path,
    *,
    network: nnx.Module | None = None,
    loss: Loss | None = None,
    optimizer: optax.GradientTransformation | None = None,
    steps: int | None = None,
    devices: int | None = None,
    report: _Report | None = None,
) -> Predictor:
    """Trains a network, or resumes the run in a folder.

    Args:
        config: Settings of the run.
        sequences: Simulated actions, including those of ``config.validation``: their entries from
            `list_entries` or folders, which are read while others are learned from, or the actions.
            Or what `load_data` made of them, for several runs on the same data: configurations
            that differ in width, loss or optimizer, but not in maps, templates or batch.
        folder: Folder for checkpoints and ``metrics.jsonl``.
        network: Any module with the signature of `Generator`; a `Generator` by default.
        loss: Any function of `LossInputs`; `configured_loss` by default.
        optimizer: Any transformation of the generator's gradients; `make_optimizer` by default.
            Non-finite updates are skipped.
        steps: Stop after this many steps in total instead of all epochs (the learning
            rate still follows the full length).
        devices: Devices of each process among which batches are split; if None, as many as divide
            them. The result doesn't depend on it, up to rounding.
        report: Callback that takes the steps done, the total steps and the newest metrics.

    Returns:
        The trained predictor.

    Raises:
        BusyError: Another process trains in the folder.
        PhysXNetError: Too many consecutive non-finite updates, the folder holds another run, or
            ``config.start`` is another model.
        FormatError: No usable data for training or validation.
    """
    folder = pathlib.Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    mesh = make_mesh(config.batch, devices)
    before = load_predictor(config.start) if config.start else None
    if before is not None and (before.config != config.model or network is not None):
        raise PhysXNetError(f"start: {config.start} is another model than that of the run.")
    data = sequences if isinstance(sequences, TrainingData) else load_data(config, sequences)
    identity = data.frames.identity
    if before is not None:
        data = _going_on(data, before)
        network = nnx.merge(before.graph, before.state)
        identity += f" from {read_card(config.start)['sha256']}"
    total = math.ceil(data.frames.steps_per_epoch * config.epochs)
    problem, first = make_problem(
        config,
        data.atlas,
        data.texel_points,
        data.normalisation,
        data.tables,
        persons=data.persons,
        motion_atlas=data.motion_atlas,
        fps=data.frames.fps,
        steps=total,
        network=network,
        loss=loss,
        optimizer=optimizer,
    )
    _check_same_run(folder / "config.json", config_json(config, identity))
    run = _Run(folder, repeated(mesh, problem), repeated(mesh, first), data, total, mesh)
    try:
        run.train(total if steps is None else min(steps, total), report)
        predictor = make_predictor(problem, at_home(run.best()))
        return predictor if before is None else _blended(before, predictor, config.blend)
    finally:
        run.close()


def _blended(before: Predictor, after: Predictor, share: float) -> Predictor:
    """A predictor between two; parameters that both have stay as they are."""

    def mix(a: jax.Array, b: jax.Array) -> jax.Array:
        return a + share * (b - a) if jnp.issubdtype(b.dtype, jnp.inexact) else b

    if share == 1.0:
        return after
    return dataclasses.replace(after, state=jax.tree.map(mix, before.state, after.state))


class _Run:
    """The run of a folder: its state, checkpoints and logs.

    Args:
        folder: Folder of the run.
        problem: What is learned.
        first: The state before the first step.
        data: Frames.
        total: Steps of the whole run.
        mesh: Devices.
    """

    def __init__(
        self,
        folder: pathlib.Path,
        problem: Problem,
        first: TrainState,
        data: TrainingData,
        total: int,
        mesh: Mesh,
    ) -> None:
        self._problem, self._first, self._data, self._total = problem, first, data, total
        self._config, self._folder, self._mesh = problem.config, folder, mesh
        self._alone = False
        self._checkpoints = Checkpoints(folder / "checkpoints")
        self._best = Checkpoints(folder / "best", keep=1)
        restored = self._checkpoints.latest(first)
        self._state = first if restored is None else restored
        self._done = int(self._state.step)
        self._best.forget_after(self._done)
        logged = read_metrics(folder)
        self._stopping = EarlyStopping(logged, self._done, self._config.patience)
        self._gan = GanMonitor(logged, self._done)
        # One process writes what isn't a checkpoint.
        self._board = TensorBoardLogger(folder) if jax.process_index() == 0 else None

    def train(self, stop: int, report: _Report | None) -> None:
        """Steps until ``stop``, or until validation stops improving."""
        config, began = self._config, time.perf_counter()
        key = jax.random.key(config.seed)

        def log(values: dict[str, float]) -> None:
            values |= {"step": self._done, "seconds": round(time.perf_counter() - began, 3)}
            if self._board is not None:
                append_line(self._folder / METRICS, values)
                self._board.write(values, self._done)
            if report is not None:
                report(self._done, stop, values)

        batches = self._data.frames.batches(self._done, own_rows(config.batch))
        try:
            self._steps(stop, batches, key, log)
        except (jax.errors.JaxRuntimeError, ValueError) as error:
            # A checkpoint raises the second for what a step raises the first for.
            lost = isinstance(error, jax.errors.JaxRuntimeError) or "Gloo" in str(error)
            if jax.process_count() == 1 or not lost:
                raise
            self._alone = True
            raise PhysXNetError(
                f"step {self._done}: another process of this run has ended. Start all of them"
                " again: training resumes from the last checkpoint."
            ) from error
        finally:
            batches.close()

    def _steps(
        self,
        stop: int,
        batches: Batches,
        key: jax.Array,
        log: Callable[[dict[str, float]], None],
    ) -> None:
        config = self._config
        began, waited = time.perf_counter(), batches.waited
        while self._done < stop and not self._stopping.exhausted:
            step_key = jax.random.fold_in(key, self._done)
            batch = split(self._mesh, next(batches))
            self._state, metrics = train_step(self._problem, self._state, batch, step_key)
            self._done += 1
            self._check_finite()
            if self._done % 20 == 0 or self._done == stop:
                values = {k: float(v) for k, v in metrics.items()}
                now = time.perf_counter()
                values["waiting_share"] = (batches.waited - waited) / (now - began)
                began, waited = now, batches.waited
                log(values | self._gan.update(values))
            # Only on schedule, so that an interrupted run stays identical.
            if self._done % config.validate_every == 0 or self._done == self._total:
                self._validate(log)
            if self._done % config.checkpoint_every == 0:
                self._checkpoints.save(self._state)

    def _check_finite(self) -> None:
        states = (self._state.generator_opt, self._state.discriminator_opt)
        skipped = max(int(s.notfinite_count) for s in states)
        if skipped >= self._config.max_skipped:
            raise PhysXNetError(
                f"step {self._done}: {skipped} updates in a row were not finite. Lower the"
                " learning rate or look for NaN in the data."
            )

    def _validate(self, log: Callable[[dict[str, float]], None]) -> None:
        if self._data.unseen is None:
            return
        losses, shown = _validate(self._problem, self._state, self._data.unseen, self._mesh)
        if self._stopping.update(losses["validation_mm"]):
            self._best.save(self._state)
        log(losses)
        if self._board is not None:
            self._board.show(shown, self._done)

    def best(self) -> TrainState:
        """The state that did best in validation; the last one without validation."""
        best = self._best.latest(self._first) if self._data.unseen is not None else None
        return self._state if best is None else best

    def close(self) -> None:
        """Saves what isn't saved yet."""
        if self._board is not None:
            self._board.close()
        # All processes write a checkpoint together.
        if self._alone:
            return
        self._checkpoints.save(self._state)
        self._checkpoints.close()
        self._best.close()


def _validate(
    problem: Problem, state: TrainState, frames: Frames | dict[str, Frames], mesh: Mesh
) -> tuple[dict[str, float], dict[str, tuple[np.ndarray, np.ndarray]]]:
    """Mean absolute errors [mm] on held-out frames, and maps of a frame in the middle."""
    config = problem.config
    sums = dict.fromkeys(config.templates, 0.0)
    weights = dict.fromkeys(config.templates, 0.0)
    shown: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    held = list(_held_batches(frames, config.batch))
    for n, batch in enumerate(held):
        losses, maps = eval_step(problem, state, repeated(mesh, batch))
        for t, value in losses.items():
            count = float(batch[f"weight_{t}"].sum())
            sums[t] += count * float(value)
            weights[t] += count
        if n == len(held) // 2:
            shown = {t: (np.asarray(a[0]), np.asarray(b[0])) for t, (a, b) in maps.items()}
    # Templates without usable cloth are left out.
    each = {f"validation_mm_{t}": sums[t] / weights[t] for t in sums if weights[t]}
    return {"validation_mm": float(np.mean(list(each.values()))), **each}, shown


def _held_batches(frames: Frames | dict[str, Frames], size: int) -> Iterator[dict[str, np.ndarray]]:
    """Every third frame: neighbours are nearly identical."""
    parts = frames if isinstance(frames, dict) else {"": frames}
    orders = {k: np.arange(0, len(f), 3) for k, f in parts.items()}
    for start in range(0, max(map(len, orders.values())), size):
        taken = {}
        for name, order in orders.items():
            real = order[start : start + size]
            taken[name] = take(parts[name], np.resize(real if len(real) else order[:1], size))
            # Padding has zero weight.
            for key in [k for k in taken[name] if k.startswith("weight_")]:
                taken[name][key][len(real) :] = 0.0
        yield join_templates(taken) if isinstance(frames, dict) else taken[""]


def _check_same_run(path: pathlib.Path, text: str) -> None:
    """Stores the settings of a run, or raises if its folder holds another run."""
    if path.is_file():
        # Settings that an earlier version didn't store have their defaults.
        before = _filled(json.loads(path.read_text()), json.loads(config_json(TrainConfig(), "")))
        now = json.loads(text)
        changed = [k for k in now if before.get(k) != now[k]]
        if changed:
            raise PhysXNetError(
                f"{path.parent}: the run there has another {', '.join(changed)}. Choose"
                " another folder or delete it."
            )
        return
    with atomic_write(path) as part:
        part.write_text(text)


def _filled(given: dict[str, Any], defaults: dict[str, Any]) -> dict[str, Any]:
    """Settings completed with defaults."""
    inner = {k: _filled(given.get(k, {}), v) for k, v in defaults.items() if isinstance(v, dict)}
    return {**defaults, **given, **inner}


def make_predictor(problem: Problem, state: TrainState) -> Predictor:
    """The predictor of a training state.

    Args:
        problem: From `make_problem`.
        state: The state to take parameters from.
    """
    network = nnx.merge(problem.generator, state.generator, state.generator_rest, copy=True)
    network.eval()
    graph, values = nnx.split(network)
    return Predictor(
        problem.atlas,
        problem.texel_points,
        problem.normalisation,
        values,
        graph,
        problem.config.model,
        coarse_atlas=problem.motion_atlas if problem.config.model.finer else None,
    )
