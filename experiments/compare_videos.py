"""Skinning, network and simulation side by side: one soft and one abrupt motion.

Command: python experiments/compare_videos.py
         --motions walk punch (built-in clips, motion files, or names of test actions),
         --data FOLDER (default: $PHYSXNET_DATA or ../shared), --wear top bottom,
         --ending mp4 (or png, gif), --out experiments/results
Cost:    about two minutes a motion on two cores, most of it simulation.
Result:  compare_MOTION.mp4 for each motion; the videos aren't committed.
"""

import argparse
import os
import pathlib

from rich.progress import Progress

from physxnet_jax.data import load_action, read_protocol
from physxnet_jax.dressing import dress
from physxnet_jax.errors import PhysXNetError
from physxnet_jax.motion import Motion
from physxnet_jax.viewer import render_columns

RESULTS = pathlib.Path(__file__).parent / "results"
TITLES = {"lbs": "skinning", "network": "network", "simulate": "simulation"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--motions", nargs="+", default=["walk", "punch"])
    parser.add_argument("--data", default=os.environ.get("PHYSXNET_DATA", "../shared"))
    parser.add_argument("--wear", nargs="+", default=["top", "bottom"])
    parser.add_argument("--weights", default="local")
    parser.add_argument("--ending", default="mp4")
    parser.add_argument("--out", default=str(RESULTS))
    words = parser.parse_args()
    out = pathlib.Path(words.out)
    out.mkdir(parents=True, exist_ok=True)
    with Progress() as bars:
        for name in words.motions:
            motion = find(name, pathlib.Path(words.data))
            bar = bars.add_task(name, total=None)

            def show(stage: str, done: int, total: int, bar=bar, name=name) -> None:
                bars.update(bar, description=f"{name}: {stage}", completed=done, total=total)

            columns = {
                title: dress(
                    motion, words.wear, method=method, weights=words.weights, progress=show
                ).meshes
                for method, title in TITLES.items()
            }
            stem = pathlib.Path(name).stem.replace(" ", "_")
            if words.wear != ["top", "bottom"]:
                stem = f"{stem}_{'_'.join(words.wear)}"
            path = out / f"compare_{stem}.{words.ending}"
            render_columns(path, columns, 30.0, size=(320, 400), progress=show)
            bars.console.print(f"wrote {path}")


def find(name: str, data: pathlib.Path) -> Motion | str:
    """The test action of that name, or the name itself for `dress` to read."""
    try:
        actions = {a.name: a for a in read_protocol(data / "mocap")}
    except PhysXNetError:
        return name
    return load_action(data / "mocap", actions[name]) if name in actions else name


if __name__ == "__main__":
    main()
