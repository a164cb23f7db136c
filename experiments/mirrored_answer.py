"""Is an answer better if the mirrored person is asked too, or several networks?

Command: python experiments/mirrored_answer.py --data runs/ours
Cost:    five minutes on two cores.
Result:  experiments/results/mirrored_answer.md, shown in docs/reproduction.md: RMSE over
         vertices, means of the twelve test actions, and its share of skinning's.

`NAME+mirror` asks the network for the mirrored person too and averages both answers: twice the
network's work. Offsets of several networks are averaged alike.
"""

import argparse
import collections
import pathlib
import statistics

import numpy as np
from rich.progress import track

from physxnet_jax.data import list_sequences, read_sequence
from physxnet_jax.evaluation import network, skinning, vertex_error
from physxnet_jax.files import whole_file
from physxnet_jax.garment import TEMPLATES
from physxnet_jax.io import MIRROR, load_predictor

RESULT = pathlib.Path(__file__).parent / "results/mirrored_answer.md"
ASKED = ("local", "small", "nano")
TOGETHER = {"local and small": ("local", "small"), "all three": ASKED}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", default="runs/ours")
    words = parser.parse_args()
    plain = skinning()
    methods = {name: network(load_predictor(name)) for n in ASKED for name in (n, f"{n}{MIRROR}")}
    errors: dict[tuple[str, str], list[float]] = collections.defaultdict(list)
    folders = list_sequences(words.data, "test")
    if not folders:
        raise SystemExit(f"{words.data}: no test actions; build the dataset first.")
    for folder in track(folders, "actions"):
        told = read_sequence(folder)
        for t in TEMPLATES:
            skinned = plain(told.motion, t).positions
            answers = {"skinning": np.zeros_like(skinned)}
            for name, method in methods.items():
                answers[name] = method(told.motion, t).positions - skinned
            for label, names in TOGETHER.items():
                for end in ("", MIRROR):
                    found = [answers[f"{n}{end}"] for n in names]
                    answers[f"{label}{', mirrored too' if end else ''}"] = sum(found) / len(found)
            for name, offset in answers.items():
                reference = skinned + told.offsets[t]
                errors[name, t].append(vertex_error(skinned + offset, reference).rmse_mm)
    lines = ["| asked | top, mm | bottom, mm | dress, mm |", "|---|---|---|---|"]
    for name in dict.fromkeys(n for n, _ in errors):
        mean = {t: statistics.fmean(errors[name, t]) for t in TEMPLATES}
        share = {t: mean[t] / statistics.fmean(errors["skinning", t]) for t in TEMPLATES}
        cells = " | ".join(f"{mean[t]:.1f} ({share[t]:.2f})" for t in TEMPLATES)
        lines.append(f"| {name} | {cells} |")
    with whole_file(RESULT) as part:
        part.write_text("\n".join(lines) + "\n")
    print("\n".join(lines))  # noqa: T201


if __name__ == "__main__":
    main()
