"""What a guide is worth: a few substeps with and without it, at several rates, live.

Command: python experiments/guided.py --data runs/clothes/default
         --weights base (default), --actions punch "salsa dance" (default),
         --parts steps rates live (default)
Cost:    about 20 minutes on two cores; goes on where it was stopped.
Result:  experiments/results/guided.json and .md.
         steps: for each template, substeps and guide: RMSE [mm] against the dataset's simulation,
         folds over its own, wrinkle error [degrees], distance of spectra, 99 % of tension and jerk
         over its own; the network and skinning beside them.
         rates: RMSE of network and guided at 24, 60 and 120 frames a second over that at 30,
         at the times that both have.
         live: median milliseconds of `clothe_step` for the dress and for three garments.
"""

import argparse
import dataclasses
import json
import math
import pathlib
import statistics
import time
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np
from rich.console import Console

from physxnet_jax.data import Sequence, garment_of, list_entries, shape_of
from physxnet_jax.dressing import (
    Dresser,
    Inference,
    Simulation,
    clothe_step,
    infer_clip,
    init_stream,
    make_dresser,
    pose_clip,
)
from physxnet_jax.evaluation import likeness, machine, skinning, vertex_error
from physxnet_jax.files import atomic_write, write_json
from physxnet_jax.garment import DEFAULT_KINDS, tailor
from physxnet_jax.models import load_predictor
from physxnet_jax.motion import Motion, resample
from physxnet_jax.simulation import Scene, prepare_scene, standard_effects
from physxnet_jax.simulation.effects import Guide

RESULTS = pathlib.Path(__file__).parent / "results"
WORN = DEFAULT_KINDS
SUBSTEPS = (4, 8, 16, 32)
# A guide that doesn't pull.
NEVER = 1e6
RATES = (24.0, 60.0, 120.0)
TIMED, ROUNDS = 60, 5


def worn_alone(data: str, template: str, action: str) -> Sequence:
    for entry in list_entries(data, "test"):
        if entry.action == action and entry.outfit is not None:
            if entry.outfit.wear == (WORN[template],):
                return entry.read()
    raise SystemExit(f"{data}: no {WORN[template]} on {action}.")


def dresser_of(worn: Any, weights: Any, substeps: int | None, guided: bool = True) -> Dresser:
    garment = garment_of(worn)
    inference = Inference(weights=weights, strain_iterations=0, collisions=False)
    if substeps is None:
        return make_dresser([garment], inference=inference, shape=shape_of(worn))
    free = (*standard_effects((garment,)), Guide(time_constant=NEVER))
    options = Simulation(substeps=substeps, effects=None if guided else free)
    return make_dresser(
        [garment], method="guided", inference=inference, shape=shape_of(worn), simulation=options
    )


def cloth_of(dresser: Dresser, motion: Motion) -> np.ndarray:
    clip = pose_clip(dresser.body, dresser.rest, motion)
    name = dresser.worn[0].name
    return np.concatenate([b.positions[name] for b in infer_clip(dresser, clip)])


def steps(data: str, weights: Any, action: str, template: str) -> Iterator[dict]:
    s = worn_alone(data, template, action)
    worn, motion = s.clothing(template), s.motion
    garment = garment_of(worn)
    scene = prepare_scene(Scene((garment,), standard_effects((garment,)), None, shape_of(worn)))
    skinned = skinning()(motion, worn).positions
    truth = skinned + s.offsets[template]

    def row(method: str, substeps: int, x: np.ndarray) -> dict:
        return {
            "part": "steps",
            "template": template,
            "action": action,
            "method": method,
            "substeps": substeps,
            **dataclasses.asdict(likeness(scene.assembly, x, truth, fps=motion.fps)),
        }

    yield row("skinning", 0, skinned)
    yield row("network", 0, cloth_of(dresser_of(worn, weights, None), motion))
    for count in SUBSTEPS:
        for guided in (True, False):
            x = cloth_of(dresser_of(worn, weights, count, guided), motion)
            yield row("guided" if guided else "unguided", count, x)


def rates(data: str, weights: Any, action: str, template: str) -> Iterator[dict]:
    s = worn_alone(data, template, action)
    worn, motion = s.clothing(template), s.motion
    truth = skinning()(motion, worn).positions + s.offsets[template]
    for method, substeps in (("network", None), ("guided", 8)):
        dresser = dresser_of(worn, weights, substeps)
        usual = cloth_of(dresser, motion)
        for fps in RATES:
            cloth = cloth_of(dresser, resample(motion, fps))
            # Frames that both have: times that are whole in either.
            every = round(motion.fps / math.gcd(round(fps), round(motion.fps)))
            here = np.arange(0, motion.num_frames, every)
            there = np.round(here * fps / motion.fps).astype(int)
            here, there = here[there < len(cloth)], there[there < len(cloth)]
            yield {
                "part": "rates",
                "template": template,
                "action": action,
                "method": method,
                "fps": fps,
                "ratio": vertex_error(cloth[there], truth[here]).rmse_mm
                / vertex_error(usual[here], truth[here]).rmse_mm,
            }


def live(data: str, weights: Any, action: str, _: str) -> Iterator[dict]:
    motion = worn_alone(data, "dress", action).motion
    step = jax.jit(clothe_step, static_argnames="fps")

    def milliseconds(dresser: Dresser) -> list[float]:
        stream = init_stream(dresser, motion.rotations[:2], motion.root[:2], motion.fps)
        times = []
        for k in range(TIMED):
            pose = motion.rotations[k], motion.root[k]
            began = time.perf_counter()
            stream, cloth = step(dresser, stream, *pose, motion.fps)
            jax.block_until_ready(cloth.vertices)
            times.append(1e3 * (time.perf_counter() - began))
        return times[10:]

    for label, kinds in (("dress", ["aline"]), ("three garments", ["trousers", "aline", "shirt"])):
        garments = [tailor(k) for k in kinds]
        counts = (None, *SUBSTEPS)
        dressers = [
            make_dresser(
                garments,
                method="network" if n is None else "guided",
                inference=Inference(weights=weights, strain_iterations=0, collisions=False),
                simulation=Simulation(substeps=n),
            )
            for n in counts
        ]
        # By turns: the machine's own pace changes from minute to minute.
        times = np.array([[milliseconds(d) for d in dressers] for _ in range(ROUNDS)])
        for k, substeps in enumerate(counts):
            yield {
                "part": "live",
                "template": label,
                "action": action,
                "method": "network" if substeps is None else "guided",
                "substeps": substeps or 0,
                "ms": statistics.median(times[:, k].ravel()),
            }


PARTS = {"steps": steps, "rates": rates, "live": live}


def table(rows: list[dict], part: str) -> str:
    mine = [r for r in rows if r["part"] == part]
    if not mine:
        return ""
    columns = [k for k in mine[0] if k not in ("part", "action")]
    kept = [k for k in columns if k in ("template", "method", "substeps", "fps")]
    numbers = [k for k in columns if k not in kept]
    groups: dict[tuple, list[dict]] = {}
    for r in mine:
        groups.setdefault(tuple(r[k] for k in kept), []).append(r)
    lines = ["| " + " | ".join([*kept, *numbers]) + " |", "|---" * len(columns) + "|"]
    for key, group in groups.items():
        means = [statistics.fmean(r[k] for r in group) for k in numbers]
        cells = [f"{x:g}" if isinstance(x, float) else str(x) for x in key]
        lines.append("| " + " | ".join([*cells, *(f"{m:.2f}" for m in means)]) + " |")
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--data", required=True)
    parser.add_argument("--weights", default="base")
    parser.add_argument("--actions", nargs="+", default=["punch", "salsa dance"])
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--out", type=pathlib.Path, default=RESULTS / "guided.json")
    options = parser.parse_args()
    weights, console = load_predictor(options.weights), Console()
    stored = json.loads(options.out.read_text()) if options.out.is_file() else {"rows": []}
    rows: list[dict] = stored["rows"]
    known = {(r["part"], r["action"], r["template"]) for r in rows}
    for part in options.parts:
        for template in ("all",) if part == "live" else WORN:
            for action in options.actions[:1] if part == "live" else options.actions:
                found = {(part, action, template), (part, action, "three garments")} & known
                if found:
                    continue
                began = time.perf_counter()
                rows += list(PARTS[part](options.data, weights, action, template))
                write_json(options.out, {"machine": machine(), "rows": rows})
                seconds = time.perf_counter() - began
                console.print(f"{part} {template} {action}: {seconds:.0f} s", highlight=False)
    text = "\n".join(table(rows, part) for part in PARTS)
    with atomic_write(options.out.with_suffix(".md")) as file:
        file.write_text(text)
    console.print(text, markup=False, highlight=False, soft_wrap=True)


if __name__ == "__main__":
    main()
