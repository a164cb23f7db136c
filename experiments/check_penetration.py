"""Cloth in the body and body out of the cloth, on every frame of the 12 test actions.

Command: python experiments/check_penetration.py
         --data FOLDER (default: $PHYSXNET_DATA or ../shared), --accuracy standard
Cost:    about 15 minutes on two cores; goes on where it was stopped.
Result:  experiments/results/penetration.json and .md: for each action and template the
         share of cloth vertices inside the body, how much of that lies where the body
         folds or passes through itself (pinched: no place above the skin is free), the
         rest (avoidable), the deepest vertex, the share of skin that sticks out of the
         cloth over it, strain, and, over every tenth frame, visible skin and the share of faces
         that cross other faces of the garment. Measured on meshes, not by the simulator.
"""

import argparse
import json
import os
import pathlib

import jax
import numpy as np
from rich.progress import track

from physxnet_jax.data import load_action, read_protocol
from physxnet_jax.evaluation import edge_strain, penetration, surface_faults
from physxnet_jax.files import atomic_write
from physxnet_jax.garment import TEMPLATES, template
from physxnet_jax.simulation import PRESETS, Scene, Status, prepare_scene, simulate_batch

RESULTS = pathlib.Path(__file__).parent / "results"
# Frames between those at which visible skin is measured.
STRIDE = 10


def one(name: str, action, folder: pathlib.Path, accuracy: str) -> dict:
    scene = prepare_scene(Scene((template(name),)))
    motion = load_action(folder / "mocap", action)
    out = simulate_batch(scene, [motion], solver=PRESETS[accuracy])[0]
    x = out.positions[0]
    seen = penetration(scene.assembly, motion, x)
    strain = edge_strain(scene.assembly, x)
    faults = surface_faults(scene.assembly, motion, x, frames=np.arange(0, len(x), STRIDE))
    acceleration = np.diff(x, n=2, axis=0) * motion.fps**2
    return {
        "action": action.name,
        "template": name,
        "frames": len(x),
        "inside_share": float(seen.cloth_inside.mean()),
        "pinched_share": float(seen.pinched.mean()),
        "avoidable_share": float((seen.cloth_inside & ~seen.pinched).mean()),
        "deepest_mm": 1e3 * float(seen.depth.max()),
        "deepest_avoidable_mm": 1e3 * float(np.where(seen.pinched, 0, seen.depth).max()),
        "frames_with_any_inside": int(seen.cloth_inside.any(axis=1).sum()),
        "skin_outside_share": float(seen.skin_outside.mean()),
        "visible_skin": faults.visible_skin,
        "self_crossing": faults.self_crossing,
        "strain_p99": float(np.quantile(strain, 0.99)),
        "strain_max": float(strain.max()),
        "acceleration_median": float(np.median(np.linalg.norm(acceleration, axis=2))),
        "frames_pinched": int(((out.status & int(Status.PINCHED)) > 0).sum()),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", default=os.environ.get("PHYSXNET_DATA", "../shared"))
    parser.add_argument("--accuracy", default="standard", choices=tuple(PRESETS))
    words = parser.parse_args()
    folder = pathlib.Path(words.data)
    path = RESULTS / "penetration.json"
    rows = json.loads(path.read_text())["rows"] if path.is_file() else []
    done = {(r["action"], r["template"]) for r in rows}
    actions = [a for a in read_protocol(folder / "mocap") if a.split == "test"]
    jobs = [(n, a) for n in TEMPLATES for a in actions if (a.name, n) not in done]
    for name, action in track(jobs, description="actions"):
        if rows and rows[-1]["template"] != name:
            # Each garment has programs of its own; kept, they would fill the memory.
            jax.clear_caches()
        rows.append(one(name, action, folder, words.accuracy))
        with atomic_write(path) as part:
            part.write_text(json.dumps({"accuracy": words.accuracy, "rows": rows}, indent=1) + "\n")
    lines = [
        "| template | frames | inside | pinched | avoidable | deepest mm (avoidable) |"
        " skin outside | visible skin (worst action) | self-crossing | strain p99 |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name in TEMPLATES:
        mine = [r for r in rows if r["template"] == name]
        n = np.asarray([r["frames"] for r in mine])

        def mean(key: str, mine: list = mine, n: np.ndarray = n) -> float:
            return float(np.average([r[key] for r in mine], weights=n))

        lines.append(
            f"| {name} | {n.sum()} | {100 * mean('inside_share'):.3f} % |"
            f" {100 * mean('pinched_share'):.3f} % | {100 * mean('avoidable_share'):.3f} % |"
            f" {max(r['deepest_mm'] for r in mine):.1f}"
            f" ({max(r['deepest_avoidable_mm'] for r in mine):.1f}) |"
            f" {100 * mean('skin_outside_share'):.3f} % | {100 * mean('visible_skin'):.3f} %"
            f" ({100 * max(r['visible_skin'] for r in mine):.3f} %) |"
            f" {100 * mean('self_crossing'):.2f} % | {mean('strain_p99'):.3f} |"
        )
    with atomic_write(path.with_suffix(".md")) as part:
        part.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
