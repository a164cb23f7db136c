"""Networks on people who stand almost still, whom no captured motion shows.

Command: python experiments/standing.py [--weights nano small base]
Cost:    about ten minutes on one core; goes on where it was stopped.
Result:  experiments/results/standing.json and .md: for the first second of built-in clips and a
         person who stands at rest, the default garments by skinning, by each network,
         and guided: RMSE [mm] against the simulation at `standard`, and by how much higher the hem
         is [mm], over the last half of the frames.
"""

import argparse
import dataclasses
import itertools
import json
import pathlib

import numpy as np
from rich.console import Console

from physxnet_jax import dress
from physxnet_jax.dressing import Inference
from physxnet_jax.evaluation import machine, vertex_error
from physxnet_jax.files import atomic_write, write_json
from physxnet_jax.garment import tailor
from physxnet_jax.motion import Motion, load_motion

RESULTS = pathlib.Path(__file__).parent / "results"
CLIPS = ("rest", "walk", "punch", "balance")
GARMENTS = ("shirt", "aline", "trousers")
FRAMES = 30
# Vertices of the hem: the lowest ones.
HEM = 300


def clip(name: str) -> Motion:
    whole = load_motion("squat" if name == "rest" else name, fps=30.0)
    rows = np.zeros(FRAMES, int) if name == "rest" else np.arange(FRAMES)
    return dataclasses.replace(whole, rotations=whole.rotations[rows], root=whole.root[rows])


def cloth(motion: Motion, garment: str, method: str, weights: str | None = None) -> np.ndarray:
    inference = None if weights is None else Inference(weights=weights)
    made = dress(motion, [garment], method=method, inference=inference, include_body=False)
    return np.asarray(made.meshes[0].positions)[FRAMES // 2 :]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--weights", nargs="+", default=["nano", "small", "base"])
    parser.add_argument("--out", type=pathlib.Path, default=RESULTS / "standing.json")
    options = parser.parse_args()
    rows = json.loads(options.out.read_text())["rows"] if options.out.is_file() else []
    known = {(r["garment"], r["clip"], r["method"]) for r in rows}
    methods = [("lbs", "lbs", None), *((w, "network", w) for w in options.weights)]
    methods.append((f"{options.weights[-1]}+guided", "guided", options.weights[-1]))
    console = Console()
    for garment, name in itertools.product(GARMENTS, CLIPS):
        left = [m for m in methods if (garment, name, m[0]) not in known]
        if not left:
            continue
        hem = np.argsort(np.asarray(tailor(garment).mesh.vertices)[:, 1])[:HEM]
        motion = clip(name)
        truth = cloth(motion, garment, "simulate")
        for label, method, weights in left:
            x = cloth(motion, garment, method, weights)
            row = {
                "garment": garment,
                "clip": name,
                "method": label,
                "rmse_mm": vertex_error(x, truth).rmse_mm,
                "hem_mm": 1e3 * float((x - truth)[:, hem, 1].mean()),
            }
            rows.append(row)
            write_json(options.out, {"machine": machine(), "rows": rows})
            console.print(row)
    names = [m[0] for m in methods]
    lines = ["| garment | clip | " + " | ".join(names) + " |", "|---" * (len(names) + 2) + "|"]
    found = {(r["garment"], r["clip"], r["method"]): r for r in rows}
    for key in itertools.product(GARMENTS, CLIPS):
        each = (found[*key, name] for name in names)
        cells = (f"{r['rmse_mm']:.0f} ({r['hem_mm']:+.0f})" for r in each)
        lines.append(f"| {key[0]} | {key[1]} | " + " | ".join(cells) + " |")
    with atomic_write(options.out.with_suffix(".md")) as file:
        file.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
