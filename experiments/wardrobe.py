"""Every garment that the tailor makes, in motion: does it stay on, hide the skin, keep its size?

Command: python experiments/wardrobe.py
         --actions punch spin squat salsa (default; salsa needs $PHYSXNET_DATA or ../shared),
         --kinds tee shirt trousers+shirt ... (all kinds and outfits by default), --ends (also the
         ends of each measure's range), --shapes (also four body shapes), --frames 60
Cost:    half a minute for the four actions of a garment, which are simulated together, on two
         cores; with --ends and --shapes two hours; goes on where it was stopped.
Result:  experiments/results/wardrobe.json and .md: for each kind, measures, shape and action the
         share of pixels with visible skin, and of an inner garment that came through an outer one,
         99 % of strain and of tension alone, how far it slid [mm] and whether it came off, the
         share of faces that cross others, how far its hem is from level at rest [mm], and the time
         a frame of one action takes.
"""

import argparse
import dataclasses
import json
import os
import pathlib
import time
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
from rich.progress import track

from physxnet_jax.body import load_body
from physxnet_jax.evaluation import edge_strain, surface_faults
from physxnet_jax.files import atomic_write
from physxnet_jax.garment import KINDS, Garment, tailor
from physxnet_jax.motion import Motion, load_motion
from physxnet_jax.simulation import (
    OFF,
    ROLLOUT_BLOCK,
    Scene,
    prepare_scene,
    simulate_batch,
    standard_effects,
)

RESULTS = pathlib.Path(__file__).parent / "results"
SHAPES = {
    "slim": {"weight_down": 1.0},
    "broad": {"weight_up": 1.0},
    "tall": {"height_up": 1.0},
    "short": {"height_down": 1.0},
}
# Garments worn together, innermost first.
OUTFITS = ("trousers+shirt", "skirt+tee", "skirt+shirt+loose")
# Frames between those that are looked at for skin and crossing faces.
STRIDE = 10


def clip(name: str, frames: int) -> Motion:
    word = name
    if name == "salsa":
        word = str(
            pathlib.Path(os.environ.get("PHYSXNET_DATA", "../shared")) / "mocap/daz/060_12.bvh"
        )
    m = load_motion(word, fps=30.0)
    return dataclasses.replace(m, rotations=m.rotations[:frames], root=m.root[:frames])


def orders(kinds: tuple[str, ...], ends: bool, shapes: bool) -> Iterator[tuple[str, dict, str]]:
    """Kinds with measures and shapes to try."""
    for kind in kinds:
        yield kind, {}, "usual"
        if ends and kind in KINDS:
            for measure, r in KINDS[kind].ranges.items():
                yield kind, {measure: r.low}, "usual"
                yield kind, {measure: r.high}, "usual"
        if shapes:
            for shape in SHAPES:
                yield kind, {}, shape


def several(
    kind: str, measures: dict, shape: str, actions: list[str], frames: int
) -> Iterator[dict]:
    """Rows of a garment or an outfit, one for each action."""
    body, motions = load_body(), [clip(action, frames) for action in actions]
    params = body.shape(**SHAPES.get(shape, {}))
    garments = tuple(tailor(k, **measures, shape=params) for k in kind.split("+"))
    scene = prepare_scene(Scene(garments, standard_effects(garments), None, params))
    ticks: list[float] = []
    outs = simulate_batch(scene, motions, progress=lambda *_: ticks.append(time.perf_counter()))
    each = 1e3 * float(np.median(np.diff(ticks)[1:])) / ROLLOUT_BLOCK / len(motions)
    for action, motion, out in zip(actions, motions, outs, strict=True):
        x = np.concatenate(out.positions, axis=1)
        strain = edge_strain(scene.assembly, x)
        faults = surface_faults(scene.assembly, motion, x, frames=np.arange(0, len(x), STRIDE))
        yield {
            "kind": kind,
            "measures": measures,
            "shape": shape,
            "action": action,
            "visible_skin": faults.visible_skin,
            "visible_inner": faults.visible_inner,
            "strain_p99": float(np.quantile(np.abs(strain), 0.99)),
            "tension_p99": float(np.quantile(strain, 0.99)),
            "moved_mm": 1e3 * float(out.diagnostics["slipped"].max()),
            "off": bool(out.diagnostics["slipped"].max() > OFF),
            "self_crossing": faults.self_crossing,
            "hem_mm": max(uneven_hem(g, scene.assembly.rest_body) for g in garments),
            "ms_per_frame": each,
            "vertices": len(scene.assembly.rest),
        }


def uneven_hem(garment: Garment, rest_body: np.ndarray) -> float:
    """Largest distance of a hem, at rest on the person, from its mean height [mm]."""
    y = np.asarray(garment.rest_vertices(jnp.asarray(rest_body, jnp.float32)))[
        np.unique(np.asarray(garment.loops["hem"])), 1
    ]
    return 1e3 * float(np.abs(y - y.mean()).max())


def table(rows: list[dict]) -> str:
    lines = [
        "| kind | tried | vertices | slid, mm | came off | visible skin, % |"
        " inner through outer, % | tension, 99 % | self-crossing, % | ms a frame |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for kind in (*KINDS, *OUTFITS):
        mine = [r for r in rows if r["kind"] == kind]
        usual = [r for r in mine if r["shape"] == "usual" and not r["measures"]]
        if not usual:
            continue
        worst_inner = 100 * max(r["visible_inner"] for r in mine)
        lines.append(
            f"| {kind.replace('+', ', ')} | {len(mine)} | {usual[0]['vertices']} |"
            f" {max(r['moved_mm'] for r in mine):.0f} | {sum(r['off'] for r in mine)} |"
            f" {100 * max(r['visible_skin'] for r in mine):.3f} |"
            f" {f'{worst_inner:.2f}' if '+' in kind else ''} |"
            f" {max(r['tension_p99'] for r in mine):.3f} |"
            f" {100 * max(r['self_crossing'] for r in mine):.1f} |"
            f" {np.median([r['ms_per_frame'] for r in usual]):.0f} |"
        )
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--actions", nargs="*", default=["punch", "spin", "squat", "salsa"])
    everything = [*KINDS, *OUTFITS]
    parser.add_argument("--kinds", nargs="*", default=everything, choices=everything)
    parser.add_argument("--ends", action="store_true")
    parser.add_argument("--shapes", action="store_true")
    parser.add_argument("--frames", type=int, default=60)
    words = parser.parse_args()
    path = RESULTS / "wardrobe.json"
    rows = json.loads(path.read_text()) if path.is_file() else []
    done = {(r["kind"], json.dumps(r["measures"]), r["shape"], r["action"]) for r in rows}
    jobs = []
    for kind, measures, shape in orders(tuple(words.kinds), words.ends, words.shapes):
        key = kind, json.dumps(measures), shape
        actions = [action for action in words.actions if (*key, action) not in done]
        if actions:
            jobs.append((kind, measures, shape, actions))
    last = None
    for kind, measures, shape, actions in track(jobs, description="garments"):
        if last not in (None, kind):
            # Each garment has programs of its own; kept, they would fill the memory.
            jax.clear_caches()
        last = kind
        rows.extend(several(kind, measures, shape, actions, words.frames))
        with atomic_write(path) as part:
            part.write_text(json.dumps(rows, indent=1) + "\n")
    with atomic_write(path.with_suffix(".md")) as part:
        part.write_text(table(rows))


if __name__ == "__main__":
    main()
