"""Time of a person-frame by the number of people simulated side by side.

Command: python experiments/batch_scaling.py [--sizes 1 4 16 64]
Cost:    about three minutes on two cores; the same command measures a CUDA machine.
Result:  experiments/results/batch_scaling.json and .md: milliseconds a person and frame of the
         dress on the built-in clips at the presets `draft` and `standard`; the RMS distance of
         the first person from the same person alone after 20 frames, next to that of two runs
         whose roots differ by 1e-6 m; and whether other company changes any bit of it.
"""

import argparse
import dataclasses
import pathlib
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
from rich.progress import track

import physxnet_jax as px
from physxnet_jax.evaluation import machine
from physxnet_jax.files import atomic_write, write_json
from physxnet_jax.motion import Motion
from physxnet_jax.simulation import PRESETS, ROLLOUT_BLOCK, Scene, prepare_scene, simulate_batch

RESULTS = pathlib.Path(__file__).parent / "results"
FRAMES, CLIPS = 20, ("punch", "walk", "spin", "balance")


@dataclasses.dataclass(frozen=True)
class Row:
    """One size of the batch."""

    preset: str
    people: int
    ms_per_person_frame: float
    from_alone_mm: float
    jitter_mm: float
    company_changes_bits: bool


def people(first: str, others: tuple[str, ...], count: int) -> list[Motion]:
    names = [first, *(others[k % len(others)] for k in range(count - 1))]
    clips = {n: px.load_motion(n, fps=30.0) for n in set(names)}
    return [
        dataclasses.replace(
            clips[n], rotations=clips[n].rotations[:FRAMES], root=clips[n].root[:FRAMES]
        )
        for n in names
    ]


def run(scene, motions, preset) -> tuple[np.ndarray, float]:
    ticks = [time.perf_counter()]
    out = simulate_batch(
        scene,
        motions,
        solver=PRESETS[preset],
        progress=lambda *_: ticks.append(time.perf_counter()),
    )
    laps = 1e3 * np.diff(ticks)[1:] / (ROLLOUT_BLOCK * len(motions))
    return out[0].positions[0], float(np.median(laps))


def rms(x: np.ndarray) -> float:
    return 1e3 * float(np.sqrt(np.mean(np.sum(np.square(x), axis=-1))))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sizes", type=int, nargs="+", default=[1, 4, 16, 64])
    sizes = parser.parse_args().sizes
    scene = prepare_scene(Scene((px.template("dress"),)))
    rows: list[Row] = []
    for preset, size in track([(p, n) for p in ("draft", "standard") for n in sizes], "batches"):
        (alone,) = people(CLIPS[0], CLIPS[1:], 1)
        base, _ = run(scene, [alone], preset)
        noise = np.random.default_rng(1).normal(0.0, 1e-6, alone.root.shape)
        moved = dataclasses.replace(alone, root=alone.root + jnp.asarray(noise, jnp.float32))
        jitter = rms(run(scene, [moved], preset)[0] - base)
        x, ms = run(scene, people(CLIPS[0], CLIPS[1:], size), preset)
        other, again = run(scene, people(CLIPS[0], CLIPS[:0:-1], size), preset)
        changed = not np.array_equal(x, other)
        rows.append(Row(preset, size, min(ms, again), rms(x - base), jitter, changed))
        jax.clear_caches()
    found = machine()
    write_json(
        RESULTS / "batch_scaling.json",
        {"machine": found, "rows": [dataclasses.asdict(r) for r in rows]},
    )
    lines = [
        f"{found['device']}, {found['cores']} cores",
        "",
        "| preset | people | ms a person and frame | from alone mm | jitter mm | bits by company |",
        "|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {r.preset} | {r.people} | {r.ms_per_person_frame:.1f} | {r.from_alone_mm:.1f} |"
        f" {r.jitter_mm:.1f} | {'changed' if r.company_changes_bits else 'equal'} |"
        for r in rows
    ]
    with atomic_write(RESULTS / "batch_scaling.md") as partial:
        partial.write_text("\n".join(lines) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
