"""How the simulator's time grows with the number of vertices, and with the batch.

Command: python experiments/sheet_scaling.py
Cost:    about a minute on two cores, on a quiet machine.
Result:  experiments/results/sheet_scaling.json and .md: milliseconds a frame and nanoseconds a
         vertex and substep of hanging sheets of 1,024 to 16,384 vertices, XPBD at its default
         setting. No size may cost many times more a vertex than the smaller ones; sag of the
         same sheets in the same run.
"""

import dataclasses
import json
import pathlib
import time

import jax
import numpy as np
from rich.progress import track

from physxnet_jax.files import atomic_write
from physxnet_jax.garment import square_sheet
from physxnet_jax.simulation import XPBD, Scene, prepare_scene, settle_on_static_body
from physxnet_jax.simulation.effects import Bend, Gravity, Pin, Stretch

RESULTS = pathlib.Path(__file__).parent / "results"
SIDES = (32, 45, 64, 90, 128)
FRAMES, REPEATS, SUBSTEPS = 10, 5, 32


@dataclasses.dataclass(frozen=True)
class Row:
    """One sheet."""

    vertices: int
    ms_per_frame: float
    ns_per_vertex_substep: float
    sag_mm: float


def measure(side: int) -> Row:
    sheet = square_sheet(side, 0.6, upright=True, pinned=np.arange(side))
    scene = prepare_scene(Scene((sheet,), (Gravity(), Stretch(compression=1.0), Bend(), Pin())))

    def run() -> tuple[float, float]:
        began = time.perf_counter()
        out = settle_on_static_body(scene, FRAMES, solver=XPBD(SUBSTEPS, 1))
        out.check()
        lowest = float(out.positions[0][-1][:, 1].min())
        return time.perf_counter() - began, lowest

    _, lowest = run()
    took = float(np.median([run()[0] for _ in range(REPEATS)]))
    n = side * side
    rest = float(np.asarray(sheet.mesh.vertices)[:, 1].min())
    return Row(
        n,
        1e3 * took / FRAMES,
        1e9 * took / (FRAMES * SUBSTEPS * n),
        1e3 * (rest - lowest),
    )


def main() -> None:
    rows = []
    for side in track(SIDES, description="sheets"):
        rows.append(measure(side))
        jax.clear_caches()
    with atomic_write(RESULTS / "sheet_scaling.json") as part:
        part.write_text(json.dumps([dataclasses.asdict(r) for r in rows], indent=1) + "\n")
    lines = ["| vertices | ms/frame | ns a vertex and substep | sag mm |", "|---|---|---|---|"]
    lines += [
        f"| {r.vertices} | {r.ms_per_frame:.1f} | {r.ns_per_vertex_substep:.0f} | {r.sag_mm:.1f} |"
        for r in rows
    ]
    with atomic_write(RESULTS / "sheet_scaling.md") as part:
        part.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
