"""Sixty seconds of salsa, cut together from the test action and back: does anything drift?

Command: python experiments/minute_of_salsa.py
         --data FOLDER (default: $PHYSXNET_DATA or ../shared)
Cost:    about two minutes on two cores.
Result:  experiments/results/minute_of_salsa.json: frames that aren't finite, the 99th percentile
         of strain and the fastest vertex in each ten seconds of 1,800 frames, trousers at the
         default setting.
"""

import argparse
import dataclasses
import json
import os
import pathlib

import jax.numpy as jnp
import numpy as np
from rich.progress import Progress

from physxnet_jax.data import load_action, read_protocol
from physxnet_jax.files import whole_file
from physxnet_jax.garment import template
from physxnet_jax.simulation import ACCURACY, Scene, prepare_scene, simulate_batch

RESULTS = pathlib.Path(__file__).parent / "results"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", default=os.environ.get("PHYSXNET_DATA", "../shared"))
    folder = pathlib.Path(parser.parse_args().data) / "mocap"
    salsa = next(a for a in read_protocol(folder) if a.name == "salsa dance")
    m = load_action(folder, salsa)
    n = m.num_frames
    index = np.abs((np.arange(1800) + n - 1) % (2 * (n - 1)) - (n - 1))
    motion = dataclasses.replace(
        m, rotations=jnp.asarray(m.rotations)[index], root=jnp.asarray(m.root)[index]
    )
    with Progress() as bars:
        task = bars.add_task("salsa", total=None)
        out = simulate_batch(
            prepare_scene(Scene((template("bottom"),))),
            [motion],
            solver=ACCURACY["standard"],
            progress=lambda done, total: bars.update(task, completed=done, total=total),
        )[0]
    d = out.diagnostics
    rows = {
        "frames": len(out.finite),
        "frames_not_finite": int((~out.finite).sum()),
        "strain_p99": [float(s.max()) for s in np.array_split(d["strain_p99"], 6)],
        "speed_max": [float(s.max()) for s in np.array_split(d["speed_max"], 6)],
    }
    with whole_file(RESULTS / "minute_of_salsa.json") as part:
        part.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
