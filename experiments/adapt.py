"""What `physxnet adapt` gains on garment files: by physics alone, and by simulations of them.

Command: python experiments/adapt.py
         --files FOLDER (default: garments in $PHYSXNET_DATA or ../shared)
         --weights base (default)
         --names tee pants ... (default: three of them)
Cost:    7 to 40 minutes a garment on two cores, beside other work; goes on where it was stopped.
Result:  experiments/results/adapt.json and .md: on two test actions that no network learned from,
         RMSE to a simulation of that very garment at `standard`, for the network before and after,
         and for guided simulation; and the time of learning.
"""

import argparse
import json
import os
import pathlib
import statistics

import numpy as np

from physxnet_jax.data import load_action, read_protocol
from physxnet_jax.dressing import Adapted, Inference, adapt, dress
from physxnet_jax.evaluation import vertex_error
from physxnet_jax.files import atomic_write, write_json
from physxnet_jax.garment import Garment, load_garment
from physxnet_jax.models import Predictor
from physxnet_jax.motion import Motion

RESULTS = pathlib.Path(__file__).parent / "results"
FILES = ("pants", "helper_skirt", "tee")
# Two actions of the test split, one soft and one abrupt.
ACTIONS = ("walking", "punch")
FRAMES = 60


def cloth_of(motion: Motion, garment: Garment, method: str, weights: Predictor | str) -> np.ndarray:
    """The garment in every frame [m]."""
    clip = dress(
        motion,
        [garment],
        method=method,  # pyright: ignore[reportArgumentType]
        inference=Inference(weights=weights),
        include_body=False,
    )
    return np.asarray(clip.garments[0].positions)


def errors(
    weights: Predictor | str, garment: Garment, clips: list[Motion], truth: list[np.ndarray]
) -> dict[str, float]:
    """RMSE [mm] of the network and of guided simulation, means over the actions."""
    return {
        method: statistics.fmean(
            vertex_error(cloth_of(m, garment, method, weights), x).rmse_mm
            for m, x in zip(clips, truth, strict=True)
        )
        for method in ("network", "guided")
    }


def measure(path: pathlib.Path, weights: str, clips: list[Motion]) -> dict:
    """The row of a garment file."""
    garment = load_garment(path)[0]
    truth = [cloth_of(m, garment, "simulate", weights) for m in clips]
    row: dict = {"garment": path.name, "template": garment.template}
    row["skinning"] = statistics.fmean(
        vertex_error(cloth_of(m, garment, "lbs", weights), x).rmse_mm
        for m, x in zip(clips, truth, strict=True)
    )
    row["before"] = errors(weights, garment, clips, truth)
    for name, simulate in (("physics", False), ("simulations", True)):
        done: Adapted = adapt(garment, weights=weights, simulate=simulate)
        row[name] = {
            **errors(done.predictor, garment, clips, truth),
            "potential": done.potential,
            "steps": done.steps,
            "seconds": sum(done.seconds),
        }
    return row


def table(rows: list[dict]) -> str:
    """A line for each garment."""
    lines = [
        "| garment | template | skinning, mm | network | adapted by physics | by simulations |"
        " guided | adapted by physics | by simulations | potential, J | minutes |",
        "|---" * 11 + "|",
    ]
    for r in rows:
        cells = [r["garment"], r["template"], f"{r['skinning']:.1f}"]
        for method in ("network", "guided"):
            cells += [f"{r[k][method]:.1f}" for k in ("before", "physics", "simulations")]
        first, last = r["physics"]["potential"]
        cells.append(f"{first:.1f}, {last:.1f}")
        cells.append(", ".join(f"{r[k]['seconds'] / 60:.1f}" for k in ("physics", "simulations")))
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    shared = pathlib.Path(os.environ.get("PHYSXNET_DATA", "../shared"))
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--files", type=pathlib.Path, default=shared / "garments")
    parser.add_argument("--names", nargs="+", default=FILES)
    parser.add_argument("--weights", default="base")
    parser.add_argument("--out", type=pathlib.Path, default=RESULTS / "adapt.json")
    options = parser.parse_args()
    path = options.out
    rows = json.loads(path.read_text()) if path.is_file() else []
    clips = []
    for action in read_protocol(shared / "mocap"):
        if action.name in ACTIONS and action.split == "test":
            m = load_action(shared / "mocap", action)
            clips.append(Motion(m.rotations[:FRAMES], m.root[:FRAMES], m.fps, m.name))
    for name in options.names:
        if all(r["garment"] != f"{name}.obj" for r in rows):
            rows.append(measure(options.files / f"{name}.obj", options.weights, clips))
            write_json(path, rows)
            with atomic_write(path.with_suffix(".md")) as part:
                part.write_text(table(rows))


if __name__ == "__main__":
    main()
