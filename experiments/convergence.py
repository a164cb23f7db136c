"""How far each solver is from converged cloth, and what it costs.

Command: python experiments/convergence.py [--data ../shared] [--only dress-punch,...]
Cost:    about an hour on two cores; every rollout is kept in runs/convergence and made once.
Result:  experiments/results/convergence.json and .md. The reference of each garment and action is
         the preset `reference` run three times, with roots that differ by 1e-6 m in each frame:
         an error is the mean distance to the three, its spread their standard deviation, and
         jitter the mean distance between them. `static` is the part of the error that is
         the same in all frames, `moving` the rest. Two rows confirm the reference: four times its
         substeps, and first order at four times its substeps. Times are medians of
         interleaved runs, next to 32 substeps of first order with 4 searches for contacts.

Punch and spin are the built-in clips from their starts, salsa is mocap/daz/060_12.bvh from 4 s;
60 frames each, after the warm-up from rest.
"""

import argparse
import dataclasses
import functools
import os
import pathlib
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
from rich.progress import track

import physxnet_jax as px
from physxnet_jax.evaluation import edge_strain, fold_strength
from physxnet_jax.files import atomic_write, write_json
from physxnet_jax.motion import Motion
from physxnet_jax.simulation import (
    PRESETS,
    XPBD,
    PreparedScene,
    Scene,
    advance,
    make_system,
    prepare_scene,
    simulate_batch,
    start_state,
)

HERE = pathlib.Path(__file__).parent
RESULTS, RUNS = HERE / "results", HERE.parent / "runs" / "convergence"
FRAMES, FPS, JITTER, TIMED, ROUNDS = 60, 30.0, 1e-6, 10, 5
SALSA, SALSA_START = "mocap/daz/060_12.bvh", 4.0
MEASURED = (("dress", "punch"), ("bottom", "salsa"), ("top", "punch"), ("dress", "spin"))
CASES = tuple((g, a) for g in ("top", "bottom", "dress") for a in ("punch", "salsa", "spin"))
BASELINE = XPBD(32, 4, order=1)
REFERENCE = PRESETS["reference"]


@dataclasses.dataclass(frozen=True)
class Row:
    """One solver on one garment and action."""

    garment: str
    action: str
    substeps: int
    queries: int
    order: int
    coarse: bool
    preset: str
    rmse_mm: float
    rmse_spread_mm: float
    jitter_mm: float
    static_mm: float
    moving_mm: float
    folds: float
    tension_p99: float
    reference_tension_p99: float
    ms_per_frame: float
    time_ratio: float


def solvers() -> list[XPBD]:
    """The rows of the table, from the cheapest."""
    rows = [XPBD(s, q, order=1) for s, q in ((16, 2), (32, 4), (64, 2), (128, 8))]
    rows += [
        XPBD(s, q) for s, q in ((8, 1), (16, 1), (32, 1), (64, 1), (96, 1), (128, 1), (192, 1))
    ]
    return list(dict.fromkeys([*rows, *(p for p in PRESETS.values() if p != REFERENCE)]))


def checks() -> list[XPBD]:
    """Finer solvers that confirm the reference."""
    n, q = REFERENCE.substeps, REFERENCE.contact_updates
    return [XPBD(4 * n, q), XPBD(4 * n, q, order=1)]


def clip(action: str, data: pathlib.Path) -> Motion:
    if action == "salsa":
        motion = px.load_motion(data / SALSA, fps=FPS)
        start = round(SALSA_START * FPS)
    else:
        motion, start = px.load_motion(action, fps=FPS), 0
    part = slice(start, start + FRAMES)
    return dataclasses.replace(motion, rotations=motion.rotations[part], root=motion.root[part])


def moved(motion: Motion, seed: int) -> Motion:
    """The motion with noise on its root; seed 0 leaves it as it is."""
    noise = np.random.default_rng(seed).normal(0.0, JITTER, motion.root.shape) * (seed > 0)
    return dataclasses.replace(motion, root=motion.root + jnp.asarray(noise, jnp.float32))


def positions(
    name: str, scene: PreparedScene, motion: Motion, solver: XPBD, seed: int
) -> np.ndarray:
    """Positions of a rollout, from the kept file if there is one."""
    settings = f"{solver.order}_{solver.substeps}_{solver.contact_updates}"
    path = RUNS / f"{name}_{settings}_{seed}.npy"
    if path.exists():
        return np.load(path)
    out = simulate_batch(scene, [moved(motion, seed)], solver=solver)[0].positions[0]
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as partial, open(partial, "wb") as file:
        np.save(file, out)
    return out


def rms(x: np.ndarray) -> float:
    return 1e3 * float(np.sqrt(np.mean(np.sum(np.square(x, dtype=np.float64), axis=-1))))


def tension(scene: PreparedScene, x: np.ndarray) -> float:
    return float(np.quantile(edge_strain(scene.assembly, x), 0.99))


def times(
    scene: PreparedScene, motion: Motion, start: np.ndarray, rows: list[XPBD]
) -> dict[XPBD, float]:
    """Milliseconds a frame: medians of interleaved runs over the first frames."""
    rotations, root = motion.rotations[: TIMED + 1, None], motion.root[: TIMED + 1, None]
    runs = {}
    for solver in rows:
        system = make_system(scene, solver)
        state = start_state(system, jnp.asarray(start)[:, :, None], solver=solver, fps=FPS)
        runs[solver] = functools.partial(
            advance, system, state, rotations, root, solver=solver, fps=FPS
        )
        jax.block_until_ready(runs[solver]())
    laps: dict[XPBD, list[float]] = {solver: [] for solver in rows}
    for _ in range(ROUNDS):
        for solver, run in runs.items():
            began = time.perf_counter()
            jax.block_until_ready(run())
            laps[solver].append(1e3 * (time.perf_counter() - began) / TIMED)
    return {solver: float(np.median(values)) for solver, values in laps.items()}


def measure(garment: str, action: str, data: pathlib.Path, every: bool) -> list[Row]:
    name = f"{garment}_{action}"
    worn = px.template(garment)
    scene, motion, faces = prepare_scene(Scene((worn,))), clip(action, data), worn.mesh.faces
    truth = [positions(name, scene, motion, REFERENCE, seed) for seed in (1, 2, 3)]
    pairs = [rms(truth[i] - truth[j]) for i, j in ((0, 1), (0, 2), (1, 2))]
    jitter = float(np.mean(pairs))
    folds = float(np.mean([fold_strength(np.asarray(faces), x) for x in truth]))
    taut = float(np.mean([tension(scene, x) for x in truth]))
    rows = [*(solvers() if every else []), REFERENCE, *checks()]
    timed = times(scene, motion, truth[0][0], solvers()) if every else {}
    names = {solver: preset for preset, solver in PRESETS.items()}
    out = []
    for solver in track(rows, f"{garment} on {action}"):
        x = positions(name, scene, motion, solver, 0)
        gaps = [x - y for y in truth]
        errors = [rms(gap) for gap in gaps]
        static = float(np.mean([rms(gap.mean(axis=0)) for gap in gaps]))
        error = float(np.mean(errors))
        ms = timed.get(solver, float("nan"))
        out.append(
            Row(
                garment=garment,
                action=action,
                substeps=solver.substeps,
                queries=solver.contact_updates,
                order=solver.order,
                coarse=False,
                preset=names.get(solver, ""),
                rmse_mm=error,
                rmse_spread_mm=float(np.std(errors)),
                jitter_mm=jitter,
                static_mm=static,
                moving_mm=float(np.sqrt(max(error**2 - static**2, 0.0))),
                folds=fold_strength(np.asarray(faces), x) / folds,
                tension_p99=tension(scene, x),
                reference_tension_p99=taut,
                ms_per_frame=ms,
                time_ratio=ms / timed[BASELINE] if every else float("nan"),
            )
        )
        jax.clear_caches()
    return out


def table(rows: list[Row]) -> str:
    lines = []
    for garment, action in CASES:
        part = [r for r in rows if (r.garment, r.action) == (garment, action)]
        if not part:
            continue
        first = part[0]
        lines += [
            f"### {garment} on {action}",
            "",
            f"Jitter {first.jitter_mm:.1f} mm; tension strain of the reference"
            f" {first.reference_tension_p99:.3f}.",
            "",
            "| preset | order | substeps | searches | error mm | static | moving | folds"
            " | tension p99 | ms a frame | over 32, 4, order 1 |",
            "|---|---|---|---|---|---|---|---|---|---|---|",
        ]
        for r in part:
            cost = (
                "| |"
                if np.isnan(r.ms_per_frame)
                else f"{r.ms_per_frame:.1f} | {r.time_ratio:.2f} |"
            )
            lines.append(
                f"| {r.preset} | {r.order} | {r.substeps} | {r.queries} | {r.rmse_mm:.1f} ±"
                f" {r.rmse_spread_mm:.1f} | {r.static_mm:.1f} | {r.moving_mm:.1f} | {r.folds:.2f}"
                f" | {r.tension_p99:.3f} | {cost}"
            )
        lines.append("")
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", default=os.environ.get("PHYSXNET_DATA", "../shared"))
    parser.add_argument("--only", default="", help="garment-action,..., printed but not saved")
    args = parser.parse_args()
    only = {tuple(x.split("-")) for x in args.only.split(",") if x}
    rows: list[Row] = []
    for case in CASES:
        if not only or case in only:
            rows += measure(*case, pathlib.Path(args.data), case in MEASURED)
            sys.stdout.write(table(rows) + "\n")
            sys.stdout.flush()
    if not only:
        write_json(RESULTS / "convergence.json", [dataclasses.asdict(r) for r in rows])
        with atomic_write(RESULTS / "convergence.md") as partial:
            partial.write_text(table(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
