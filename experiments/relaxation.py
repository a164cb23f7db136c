"""What bringing cloth back to its lengths is worth, step by step, and what it costs.

Command: python experiments/relaxation.py --data runs/ours
Cost:    17 minutes beside other work on two cores.
Result:  experiments/results/relaxation.md, shown in docs/accuracy-cost.md: means over the
         twelve test actions and three templates.

`NAME+relax` takes eight steps (`physxnet_jax.models.RELAXATION`).
"""

import argparse
import collections
import pathlib
import statistics

import numpy as np
from rich.progress import track

from physxnet_jax.data import list_sequences, read_sequence
from physxnet_jax.dressing import pushed_network
from physxnet_jax.evaluation import (
    area_strain,
    edge_strain,
    fold_strength,
    jitter,
    network,
    skinning,
    vertex_error,
    wrinkle_error,
)
from physxnet_jax.files import whole_file
from physxnet_jax.garment import TEMPLATES, template
from physxnet_jax.io import load_predictor
from physxnet_jax.models import relax_cloth
from physxnet_jax.simulation import Scene, prepare_scene

RESULT = pathlib.Path(__file__).parent / "results/relaxation.md"
STEPS = (0, 2, 4, 8, 16, 32)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", default="runs/ours")
    parser.add_argument("--weights", default="local")
    words = parser.parse_args()
    folders = list_sequences(words.data, "test")
    if not folders:
        raise SystemExit(f"{words.data}: no test actions; build the dataset first.")
    plain, trained = skinning(), load_predictor(words.weights)
    methods = {
        f"{words.weights}{push}, {n} steps": make(relax_cloth(trained, n))
        for push, make in (("", network), ("+push", pushed_network))
        for n in STEPS
    }
    found: dict[tuple[str, str], list[dict[str, float]]] = collections.defaultdict(list)
    # Template by template: every method compiles once for each.
    jobs = [(t, f) for t in TEMPLATES for f in folders]
    scenes = {t: prepare_scene(Scene((template(t),))).assembly for t in TEMPLATES}
    for t, folder in track(jobs, "actions"):
        told = read_sequence(folder)
        skinned = plain(told.motion, t).positions
        reference = skinned + told.offsets[t]
        answers = {"simulation": (reference, 0.0), "skinning": (skinned, 0.0)}
        for name, method in methods.items():
            answer = method(told.motion, t)
            answers[name] = (answer.positions, answer.ms_per_frame)
        faces = np.asarray(scenes[t].faces)
        for name, (x, ms) in answers.items():
            found[name, t].append(
                {
                    "rmse": vertex_error(x, reference).rmse_mm,
                    "strain": float(np.quantile(np.abs(edge_strain(scenes[t], x)), 0.99)),
                    "area": float(np.quantile(np.abs(area_strain(scenes[t].rest, faces, x)), 0.99)),
                    "folds": fold_strength(faces, x) / fold_strength(faces, reference),
                    "wrinkles": wrinkle_error(faces, x, reference),
                    "jerk": jitter(x, 30.0) / jitter(reference, 30.0),
                    "ms": ms,
                }
            )
    lines = [
        "| cloth | top, mm | bottom, mm | dress, mm | edge strain 99 % | area strain 99 % |"
        " folds over simulation's | wrinkles, deg | jerk over simulation's |"
        " ms a frame and garment |",
        "|" + "---|" * 10,
    ]
    for name in dict.fromkeys(n for n, _ in found):

        def mean(what: str, these: tuple[str, ...] = TEMPLATES, name: str = name) -> float:
            return statistics.fmean(r[what] for t in these for r in found[name, t])

        errors = " | ".join(f"{mean('rmse', (t,)):.1f}" for t in TEMPLATES)
        rest = f"{mean('strain'):.2f} | {mean('area'):.2f} | {mean('folds'):.2f}"
        rest += f" | {mean('wrinkles'):.1f} | {mean('jerk'):.2f}"
        took = f"{mean('ms'):.1f}" if mean("ms") else ""
        lines.append(f"| {name} | {errors} | {rest} | {took} |")
    with whole_file(RESULT) as part:
        part.write_text("\n".join(lines) + "\n")
    print("\n".join(lines))  # noqa: T201


if __name__ == "__main__":
    main()
