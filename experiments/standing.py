"""Networks on people who stand almost still, whom no captured motion shows.

Command: python experiments/standing.py [--weights nano small base]
Cost:    about ten minutes on two cores; goes on where it was stopped.
Result:  experiments/results/standing.json and .md: for the built-in clips' first second and a
         person who stands at rest, the default dress by skinning, by each network, and guided: RMSE
         [mm] against the simulation at `standard`, and by how much higher the hem is [mm], over
         the last half of the frames.
"""

import argparse
import dataclasses
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
CLIPS = ("rest", "walk", "punch", "squat", "spin", "balance")
FRAMES = 30
# Vertices of the hem: the lowest ones.
HEM = 300


def clip(name: str) -> Motion:
    whole = load_motion("squat" if name == "rest" else name, fps=30.0)
    rows = np.zeros(FRAMES, int) if name == "rest" else np.arange(FRAMES)
    return dataclasses.replace(whole, rotations=whole.rotations[rows], root=whole.root[rows])


def cloth(motion: Motion, method: str, weights: str | None = None) -> np.ndarray:
    inference = None if weights is None else Inference(weights=weights)
    made = dress(motion, ["aline"], method=method, inference=inference, include_body=False)
    return np.asarray(made.meshes[0].positions)[FRAMES // 2 :]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--weights", nargs="+", default=["nano", "small", "base"])
    parser.add_argument("--out", type=pathlib.Path, default=RESULTS / "standing.json")
    options = parser.parse_args()
    hem = np.argsort(np.asarray(tailor("aline").mesh.vertices)[:, 1])[:HEM]
    rows = json.loads(options.out.read_text())["rows"] if options.out.is_file() else []
    known = {(r["clip"], r["method"]) for r in rows}
    methods = [("lbs", "lbs", None), *((w, "network", w) for w in options.weights)]
    methods.append((f"{options.weights[-1]}+guided", "guided", options.weights[-1]))
    console = Console()
    for name in CLIPS:
        left = [m for m in methods if (name, m[0]) not in known]
        if not left:
            continue
        motion = clip(name)
        truth = cloth(motion, "simulate")
        for label, method, weights in left:
            x = cloth(motion, method, weights)
            row = {
                "clip": name,
                "method": label,
                "rmse_mm": vertex_error(x, truth).rmse_mm,
                "hem_mm": 1e3 * float((x - truth)[:, hem, 1].mean()),
            }
            rows.append(row)
            write_json(options.out, {"machine": machine(), "rows": rows})
            console.print(row)
    lines = ["| clip | method | RMSE mm | hem higher by, mm |", "|---|---|---|---|"]
    for r in rows:
        lines.append(f"| {r['clip']} | {r['method']} | {r['rmse_mm']:.1f} | {r['hem_mm']:.0f} |")
    with atomic_write(options.out.with_suffix(".md")) as file:
        file.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
