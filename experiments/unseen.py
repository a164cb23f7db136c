"""Garments and body shapes that no network has seen, against simulations of the same.

Command: python experiments/unseen.py
         --data FOLDER (default: $PHYSXNET_DATA or ../shared), --weights local+relax
Cost:    six minutes on two cores; goes on where it was stopped.
Result:  experiments/results/unseen.json and .md: RMSE of network and skinning to a
         simulation of that very garment or shape, and the share of vertices inside.
"""

import argparse
import json
import os
import pathlib

import jax
import numpy as np
from rich.progress import track

from physxnet_jax.body import load_body
from physxnet_jax.data import load_action, read_protocol
from physxnet_jax.dressing import Inference, dress
from physxnet_jax.evaluation import vertex_error
from physxnet_jax.files import atomic_write
from physxnet_jax.garment import load_garment
from physxnet_jax.motion import Motion

RESULTS = pathlib.Path(__file__).parent / "results"
# Two actions of the test split, one soft and one abrupt.
ACTIONS = ("walking", "punch")
FRAMES = 60
GARMENTS = ("tee", "longsleeve", "pants", "F_Dress_01")
SHAPES = {
    "heavier": {"weight_up": 0.6},
    "taller man": {"gender": 0.8, "height_up": 0.4},
    "slighter": {"weight_down": 0.6, "height_down": 0.4},
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", default=os.environ.get("PHYSXNET_DATA", "../shared"))
    parser.add_argument("--weights", default="local+relax")
    words = parser.parse_args()
    folder = pathlib.Path(words.data)
    path = RESULTS / "unseen.json"
    rows = json.loads(path.read_text()) if path.is_file() else []
    done = {(r["what"], r["garment"], r["action"]) for r in rows}
    jobs = [(g, None) for g in GARMENTS]
    jobs += [(t, s) for s in SHAPES for t in ("top", "bottom", "dress")]
    clips = {}
    for action in read_protocol(folder / "mocap"):
        if action.name in ACTIONS and action.split == "test":
            m = load_action(folder / "mocap", action)
            clips[action.name] = Motion(m.rotations[:FRAMES], m.root[:FRAMES], m.fps, m.name)
    for name, shape in track(jobs, description="garments and shapes"):
        if all((shape or "garment", name, a) in done for a in ACTIONS):
            continue
        # Every garment and shape has programs of its own.
        jax.clear_caches()
        garment = load_garment(folder / "garments" / f"{name}.obj")[0] if shape is None else name
        figure = None if shape is None else load_body().shape(**SHAPES[shape])
        for action, motion in clips.items():
            worn = {
                m: dress(
                    motion,
                    [garment],
                    method=m,
                    inference=Inference(
                        weights=words.weights, strain_iterations=0, collisions=m == "network"
                    ),
                    shape=figure,
                    include_body=False,
                )
                for m in ("simulate", "network", "lbs")
            }
            cloth = {m: np.asarray(c.garments[0].positions) for m, c in worn.items()}
            row = {"what": shape or "garment", "garment": name, "action": action}
            for m in ("network", "lbs"):
                row[f"rmse_{m}_mm"] = vertex_error(cloth[m], cloth["simulate"]).rmse_mm
                row[f"inside_{m}"] = next(iter(worn[m].inside.values()))
            rows.append(row)
            with atomic_write(path) as part:
                part.write_text(json.dumps(rows, indent=1) + "\n")
    lines = [
        "| what | garment | action | network, mm | lbs, mm | network / lbs | inside, % |",
        "|---|---|---|---|---|---|---|",
    ]
    for r in rows:
        ratio = r["rmse_network_mm"] / r["rmse_lbs_mm"]
        lines.append(
            f"| {r['what']} | {r['garment']} | {r['action']} | {r['rmse_network_mm']:.1f} |"
            f" {r['rmse_lbs_mm']:.1f} | {ratio:.2f} | {100 * r['inside_network']:.2f} |"
        )
    with atomic_write(path.with_suffix(".md")) as part:
        part.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
