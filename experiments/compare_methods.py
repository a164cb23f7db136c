"""Skinning, network, guided and converged simulation side by side: a sheet and two videos.

Command: python experiments/compare_methods.py
         --weights base (default), --file GARMENT (default: F_Dress_01.obj in garments of
         $PHYSXNET_DATA or ../shared), --frames 90, --out out
Cost:    about ten minutes on two cores, most of it the converged simulation.
Result:  OUT/compare_ACTION_OUTFIT.png for a soft and an abrupt action in the shirt over the
         trousers, the A-line dress and the file, OUT/compare.png, all of these, and
         OUT/compare_ACTION_dress.mp4.
"""

import argparse
import os
import pathlib

import numpy as np
from rich.console import Console

from physxnet_jax.data import load_action, read_protocol
from physxnet_jax.dressing import DressedClip, Inference, Simulation, dress
from physxnet_jax.motion import Motion
from physxnet_jax.viewer import render_columns

# A soft and an abrupt action of the test split.
ACTIONS = ("walking", "punch")
METHODS = {
    "skinning": {"method": "lbs"},
    "network": {"method": "network"},
    "guided": {"method": "guided"},
    "converged": {"method": "simulate", "simulation": Simulation(accuracy="reference")},
}


def main() -> None:
    shared = pathlib.Path(os.environ.get("PHYSXNET_DATA", "../shared"))
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--weights", default="base")
    parser.add_argument("--file", type=pathlib.Path, default=shared / "garments/F_Dress_01.obj")
    parser.add_argument("--frames", type=int, default=90)
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("out"))
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    outfits = {"shirt": ("trousers", "shirt"), "dress": ("aline",), "file": (str(options.file),)}
    console = Console()
    for action in read_protocol(shared / "mocap"):
        if action.name not in ACTIONS or action.split != "test":
            continue
        m = load_action(shared / "mocap", action)
        motion = Motion(m.rotations[: options.frames], m.root[: options.frames], m.fps, m.name)
        for name, wear in outfits.items():
            columns = {}
            for title, way in METHODS.items():
                clip: DressedClip = dress(
                    motion, wear, inference=Inference(weights=options.weights), **way
                )
                columns[title] = clip.meshes
                inside = max(clip.inside.values())
                console.print(f"{action.name}, {name}, {title}: {100 * inside:.2f} % inside")
            stem = f"compare_{action.slug}_{name}"
            render_columns(options.out / f"{stem}.png", columns, m.fps, size=(480, 544))
            if name == "dress":
                render_columns(options.out / f"{stem}.mp4", columns, m.fps, size=(320, 416))
            console.print(f"wrote {options.out / stem}", highlight=False)
    sheet(options.out, outfits)


def sheet(folder: pathlib.Path, outfits: dict) -> None:
    """All pictures under one another."""
    import imageio.v3 as iio

    rows = [iio.imread(folder / f"compare_{a}_{n}.png") for a in ACTIONS for n in outfits]
    width = min(r.shape[1] for r in rows)
    iio.imwrite(folder / "compare.png", np.concatenate([r[:, :width] for r in rows]))


if __name__ == "__main__":
    main()
