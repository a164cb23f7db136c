"""The network beside cloth engines: three garments, one walk, one machine, one run.

Command: PHYSXNET_BLENDER=PYTHON-WITH-BPY PHYSXNET_NEWTON=PYTHON-WITH-NEWTON
         python experiments/bench_engines.py
         --engines blender newton, --weights small, --frames 60,
         --out experiments/results/engines.json
Cost:    14 minutes on two cores, most of it Newton, Blender and compilation.
Result:  engines.json and .md: milliseconds a frame for top, bottom and dress, from joint
         rotations to vertices, and how far each is from our simulator on that walk. Engines
         and the simulator take the garments one after the other; their time is the sum of
         their medians. What one engine calls cloth another would not: the distance of
         Blender and Newton is that of two models, not an error of theirs.
"""

import argparse
import json
import os
import pathlib
import statistics
import time

import jax
import numpy as np
from rich.progress import Progress

from physxnet_jax.body import load_body
from physxnet_jax.dressing import EXTERNAL_ENGINES, Inference, dress
from physxnet_jax.evaluation import network_costs
from physxnet_jax.files import atomic_write
from physxnet_jax.garment import TEMPLATES, template
from physxnet_jax.models import load_predictor
from physxnet_jax.motion import Motion, load_motion
from physxnet_jax.simulation import (
    PRESETS,
    Rollout,
    Scene,
    prepare_scene,
    simulate_batch,
    standard_effects,
)

RESULTS = pathlib.Path(__file__).parent / "results"


def simulated(name: str, scene: Scene, motion: Motion) -> tuple[Rollout, float]:
    """A rollout and its milliseconds a frame, warm."""
    if name in EXTERNAL_ENGINES:
        rollout = EXTERNAL_ENGINES[name](scene, motion)
        return rollout, float(np.median(rollout.diagnostics["milliseconds"]))
    prepared, solver = prepare_scene(scene), PRESETS[name]
    # Blocks of ten frames; the first one compiles.
    ticks: list[float] = []
    rollout = simulate_batch(
        prepared, [motion], solver=solver, progress=lambda *_: ticks.append(time.perf_counter())
    )[0]
    rollout.check()
    return rollout, 1e3 * float(np.median(np.diff(ticks))) / 10


def rmse(one: np.ndarray, other: np.ndarray) -> float:
    return 1e3 * float(np.sqrt(np.mean(np.sum((one - other) ** 2, axis=2))))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--engines", nargs="*", default=list(EXTERNAL_ENGINES), choices=list(EXTERNAL_ENGINES)
    )
    parser.add_argument("--weights", default="small")
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--out", default=str(RESULTS / "engines.json"))
    words = parser.parse_args()
    walk = load_motion("walk", fps=30.0)
    motion = Motion(walk.rotations[: words.frames], walk.root[: words.frames], walk.fps)
    body = load_body()
    names = ["standard", "draft", *words.engines]
    cloth: dict[str, dict[str, np.ndarray]] = {n: {} for n in names}
    times: dict[str, list[float]] = {n: [] for n in names}
    with Progress() as bars:
        bar = bars.add_task("simulations", total=len(names) * len(TEMPLATES))
        for t in TEMPLATES:
            scene = Scene((template(t),), standard_effects((template(t),)), body)
            for name in names:
                rollout, ms = simulated(name, scene, motion)
                cloth[name][t] = np.asarray(rollout.positions[0])
                times[name].append(ms)
                bars.update(bar, advance=1)
            jax.clear_caches()
    truth = cloth["standard"]
    rows = [
        {
            "method": name if name in EXTERNAL_ENGINES else f"simulator {name}",
            "way": "a garment at a time",
            "ms_per_frame": sum(times[name]),
            "rmse_mm": statistics.fmean(rmse(cloth[name][t], truth[t]) for t in TEMPLATES),
        }
        for name in names
    ]
    errors = {}
    for collisions in (False, True):
        worn = {
            t: dress(
                motion,
                [t],
                inference=Inference(
                    weights=words.weights, strain_iterations=0, collisions=collisions
                ),
                include_body=False,
            )
            for t in TEMPLATES
        }
        errors["network+push" if collisions else "network"] = {
            t: rmse(clip.garments[0].positions, truth[t]) for t, clip in worn.items()
        }
    predictor = load_predictor(words.weights)
    for cost in network_costs(words.weights, predictor, motion, errors, garments=(3,)):
        rows.append(
            {
                "method": f"{cost.method} {cost.size}",
                "way": "live" if cost.batch == 1 else f"{cost.batch} frames at once",
                "ms_per_frame": cost.ms_per_frame,
                "rmse_mm": cost.rmse_mm,
            }
        )
    slowest = {r["method"]: r["ms_per_frame"] for r in rows}
    lines = ["| method | way | ms a frame | mm from our simulator | Blender over it |"]
    lines += ["|---|---|---|---|---|"]
    for r in rows:
        times_faster = slowest.get("blender", float("nan")) / r["ms_per_frame"]
        r["blender_over_it"] = None if np.isnan(times_faster) else times_faster
        shown = "" if np.isnan(times_faster) else f"{times_faster:.1f}"
        lines.append(
            f"| {r['method']} | {r['way']} | {r['ms_per_frame']:.1f} | {r['rmse_mm']:.1f} |"
            f" {shown} |"
        )
    data = {
        "machine": f"{os.cpu_count()} cores; {jax.devices()[0].device_kind}; jax {jax.__version__}",
        "frames": words.frames,
        "rows": [{k: _short(v) for k, v in r.items()} for r in rows],
    }
    out = pathlib.Path(words.out)
    with atomic_write(out) as part:
        part.write_text(json.dumps(data, indent=1) + "\n")
    with atomic_write(out.with_suffix(".md")) as part:
        part.write_text("\n".join(lines) + "\n")
    bars.console.print(f"wrote {out} and .md")


def _short(value: object) -> object:
    return float(f"{value:.4g}") if isinstance(value, float) else value


if __name__ == "__main__":
    main()
