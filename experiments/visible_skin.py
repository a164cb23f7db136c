"""Skin that one sees through cloth, and cloth that crosses itself, with and without samples.

Command: python experiments/visible_skin.py [--data ../shared]
Cost:    about eight minutes on two cores; goes on where it was stopped.
Result:  experiments/results/visible_skin.json and .md: for the three templates, each garment file
         and the top over the trousers, on punch (built in) and salsa (mocap/daz/060_12.bvh from
         4 s), 60 frames at the preset `standard`: the share of pixels that show skin which came
         through the cloth over it, that of pixels that show an inner garment through an outer
         one, and that of faces that cross other faces, over every tenth frame. Without samples,
         contact keeps only vertices off the skin.
"""

import argparse
import dataclasses
import json
import os
import pathlib
import sys

import jax
import numpy as np
from rich.progress import track

import physxnet_jax as px
from convergence import clip
from physxnet_jax.evaluation import surface_faults
from physxnet_jax.files import atomic_write, write_json
from physxnet_jax.garment import TEMPLATES
from physxnet_jax.simulation import (
    PRESETS,
    Scene,
    Status,
    prepare_scene,
    simulate_batch,
    standard_effects,
)
from physxnet_jax.simulation.effects import BodyContact

RESULTS = pathlib.Path(__file__).parent / "results"
ACTIONS, STRIDE, NO_SAMPLES = ("punch", "salsa"), 10, 10.0


@dataclasses.dataclass(frozen=True)
class Row:
    """One garment on one action."""

    garment: str
    action: str
    sampled: bool
    samples: int
    visible_skin: float
    visible_inner: float
    self_crossing: float
    frames_flagged: dict[str, int]


def measure(garment: str, action: str, sampled: bool, data: pathlib.Path) -> Row:
    names = garment.split("+")
    paths = [n if n in TEMPLATES else data / "garments" / f"{n}.obj" for n in names]
    worn = tuple(px.load_garment(path)[0] for path in paths)
    contact = BodyContact() if sampled else BodyContact(sample_spacing=NO_SAMPLES)
    effects = tuple(contact if isinstance(e, BodyContact) else e for e in standard_effects(worn))
    scene, motion = prepare_scene(Scene(worn, effects)), clip(action, data)
    (out,) = simulate_batch(scene, [motion], solver=PRESETS["standard"])
    frames = np.arange(0, motion.num_frames, STRIDE)
    x = np.concatenate(out.positions, axis=1)
    seen = surface_faults(scene.assembly, motion, x, frames=frames)
    counts = {f.name or "": int(np.count_nonzero(out.status & int(f))) for f in Status}
    held = [getattr(e, "samples", None) for e in scene.effects]
    samples = sum(h.count for h in held if h is not None)
    return Row(
        garment,
        action,
        sampled,
        samples,
        seen.visible_skin,
        seen.visible_inner,
        seen.self_crossing,
        {k: n for k, n in counts.items() if n},
    )


def table(rows: list[Row]) -> str:
    lines = [
        "| garment | action | visible skin without samples | with | samples | self-crossing |"
        " inner garment |",
        "|---|---|---|---|---|---|---|",
    ]
    for garment, action in dict.fromkeys((r.garment, r.action) for r in rows):
        pair = [r for r in rows if (r.garment, r.action) == (garment, action)]
        plain, sampled = min(pair, key=lambda r: r.sampled), max(pair, key=lambda r: r.sampled)
        inner = f"{100 * sampled.visible_inner:.3f} %" if "+" in garment else ""
        without = f"{100 * plain.visible_skin:.3f} %" if len(pair) == 2 else ""
        lines.append(
            f"| {garment} | {action} | {without} | {100 * sampled.visible_skin:.3f} % |"
            f" {sampled.samples} | {100 * sampled.self_crossing:.2f} % | {inner} |"
        )
    return "\n".join(lines) + "\n"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", default=os.environ.get("PHYSXNET_DATA", "../shared"))
    data = pathlib.Path(parser.parse_args().data)
    path = RESULTS / "visible_skin.json"
    rows = [Row(**r) for r in json.loads(path.read_text())] if path.is_file() else []
    done = {(r.garment, r.action, r.sampled) for r in rows}
    files = sorted(p.stem for p in (data / "garments").glob("*.obj"))
    # Templates have hardly an edge that is long enough for a sample.
    jobs = [(n, a, True) for n in (*TEMPLATES, "bottom+top") for a in ACTIONS]
    jobs += [(n, a, s) for n in files for a in ACTIONS for s in (False, True)]
    for job in track([j for j in jobs if j not in done], "garments"):
        rows.append(measure(*job, data))
        write_json(path, [dataclasses.asdict(r) for r in rows])
        jax.clear_caches()
    with atomic_write(path.with_suffix(".md")) as partial:
        partial.write_text(table(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
