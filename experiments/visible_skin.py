"""Skin that one sees through cloth, and cloth that crosses itself, with and without samples.

Command: python experiments/visible_skin.py [--data ../shared]
Cost:    about ten minutes on two cores; goes on where it was stopped.
Result:  experiments/results/visible_skin.json and .md: for the three templates and each garment
         file, on punch (built in) and salsa (mocap/daz/060_12.bvh from 4 s), 60 frames at the
         preset `standard`: the share of pixels that show skin which came through the cloth
         over it, and that of faces that cross other faces, over every tenth frame. Without
         samples, contact keeps only vertices off the skin.
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
    STANDARD,
    Scene,
    Status,
    prepare_scene,
    simulate_batch,
)
from physxnet_jax.simulation.effects import BodyContact

RESULTS = pathlib.Path(__file__).parent / "results"
ACTIONS, STRIDE, NO_SAMPLES = ("punch", "salsa"), 10, 10.0


@dataclasses.dataclass(frozen=True)
class Row:
    """One garment on one action."""

    garment: str
    action: str
    samples: int
    visible_skin: float
    self_crossing: float
    frames_flagged: dict[str, int]


def measure(garment: str, action: str, sampled: bool, data: pathlib.Path) -> Row:
    path = garment if garment in TEMPLATES else data / "garments" / f"{garment}.obj"
    worn, _ = px.load_garment(path)
    contact = BodyContact() if sampled else BodyContact(sample_spacing=NO_SAMPLES)
    effects = tuple(contact if isinstance(e, BodyContact) else e for e in STANDARD)
    scene, motion = prepare_scene(Scene((worn,), effects)), clip(action, data)
    (out,) = simulate_batch(scene, [motion], solver=PRESETS["standard"])
    frames = np.arange(0, motion.num_frames, STRIDE)
    seen = surface_faults(scene.assembly, motion, out.positions[0], frames=frames)
    counts = {f.name or "": int(np.count_nonzero(out.status & int(f))) for f in Status}
    samples = next(e.samples.count for e in scene.effects if hasattr(e, "samples"))
    return Row(
        garment,
        action,
        samples,
        seen.visible_skin,
        seen.self_crossing,
        {k: n for k, n in counts.items() if n},
    )


def table(rows: list[Row]) -> str:
    lines = [
        "| garment | action | visible skin without samples | with | samples | self-crossing |",
        "|---|---|---|---|---|---|",
    ]
    for garment, action in dict.fromkeys((r.garment, r.action) for r in rows):
        pair = [r for r in rows if (r.garment, r.action) == (garment, action)]
        if len(pair) == 2:
            plain, sampled = sorted(pair, key=lambda r: r.samples)
            lines.append(
                f"| {garment} | {action} | {100 * plain.visible_skin:.3f} % |"
                f" {100 * sampled.visible_skin:.3f} % | {sampled.samples} |"
                f" {100 * sampled.self_crossing:.2f} % |"
            )
    return "\n".join(lines) + "\n"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", default=os.environ.get("PHYSXNET_DATA", "../shared"))
    data = pathlib.Path(parser.parse_args().data)
    path = RESULTS / "visible_skin.json"
    rows = [Row(**r) for r in json.loads(path.read_text())] if path.is_file() else []
    done = {(r.garment, r.action, r.samples > 0) for r in rows}
    names = [*TEMPLATES, *sorted(p.stem for p in (data / "garments").glob("*.obj"))]
    jobs = [(n, a, s) for n in names for a in ACTIONS for s in (False, True)]
    for job in track([j for j in jobs if j not in done], "garments"):
        rows.append(measure(*job, data))
        write_json(path, [dataclasses.asdict(r) for r in rows])
        jax.clear_caches()
    with atomic_write(path.with_suffix(".md")) as partial:
        partial.write_text(table(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
