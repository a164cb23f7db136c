"""What it costs to take a clip to have begun in motion, against a simulation that begins at rest.

Command: python experiments/clip_start.py --data runs/ours
Cost:    a minute.
Result:  experiments/results/clip_start.md: RMSE of the first frames of the test actions, told
         that the person stood still before, as `evaluate` does, and that the motion went on as it
         begins, as `dress` does.
"""

import argparse
import pathlib

import numpy as np
from rich.progress import track

from physxnet_jax.data import list_sequences, read_sequence
from physxnet_jax.dressing import clothe, make_dresser
from physxnet_jax.evaluation import network, skinning
from physxnet_jax.files import whole_file
from physxnet_jax.garment import TEMPLATES
from physxnet_jax.io import load_predictor
from physxnet_jax.training import usable_garment

OUT = pathlib.Path(__file__).parent / "results/clip_start.md"
FRAMES = 6


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", default="runs/ours")
    parser.add_argument("--weights", default="local")
    words = parser.parse_args()
    predictor = load_predictor(words.weights)
    still = network(predictor)
    head = " | ".join(f"frame {k}" for k in range(FRAMES))
    lines = [f"| garment | before it | {head} |", "|---" * (FRAMES + 2) + "|"]
    sequences = [read_sequence(f) for f in list_sequences(words.data, "test")]
    for name in TEMPLATES:
        dresser = make_dresser([name], weights=predictor, push_out=False)
        squares: dict[str, list[np.ndarray]] = {"stood still": [], "in motion": []}
        for s in track(sequences, description=name, transient=True):
            if name not in s.offsets or not usable_garment(s.meta[name]):
                continue
            wanted = (skinning()(s.motion, name).positions + s.offsets[name])[:FRAMES]
            q, p = s.motion.rotations[:16], s.motion.root[:16]
            told = {
                "stood still": still(s.motion, name).positions,
                "in motion": np.asarray(clothe(dresser, q, p, s.motion.fps)[name]),
            }
            for way, x in told.items():
                squares[way].append(np.sum((x[:FRAMES] - wanted) ** 2, axis=2).mean(axis=1))
        for way, each in squares.items():
            rmse = 1e3 * np.sqrt(np.mean(each, axis=0))
            lines.append(f"| {name} | {way} | {' | '.join(f'{e:.1f}' for e in rmse)} |")
    with whole_file(OUT) as part:
        part.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
