"""What each part of the recipe is worth: one change at a time.

Command: python experiments/ablations.py --data runs/ours --extra runs/extra --slow runs/slow
         --other runs/blender
Cost:    5 to 10 minutes a variant on two cores beside other work (maps of 256 x 256: half an
         hour); goes on where it was stopped. Variants whose dataset isn't built are left out
         and said so.
Result:  experiments/results/ablations.json and .md: RMSE over vertices of the twelve test
         actions for each template, beside skinning. The seconds of a training step are in
         the JSON alone: a machine that does other things beside makes them incomparable.

Every variant is `base` (64 x 64, width 16, local frame, three frames, L1 alone, seven tenths
of it at vertices, 22 training actions, three epochs) with one thing changed; those with more
data take as many steps as `base`. `engine` names what made the reference. The world's frame
has no loss at vertices: its row is to be read beside "texels alone".
"""

import argparse
import dataclasses
import json
import pathlib
import statistics

import jax
from rich.progress import Progress

from physxnet_jax.data import Sequence, list_sequences, read_sequence, usable_garment
from physxnet_jax.evaluation import Method, network, skinning, vertex_error
from physxnet_jax.files import atomic_write
from physxnet_jax.garment import TEMPLATES
from physxnet_jax.models import FeatureConfig, ModelConfig, save_predictor
from physxnet_jax.training import TrainConfig, read_metrics, train

RESULTS = pathlib.Path(__file__).parent / "results"

BASE = TrainConfig(
    model=ModelConfig(FeatureConfig("local"), resolution=64, width=16),
    epochs=3,
    batch=8,
    learning_rate=3e-3,
    schedule="cosine",
    adversarial=False,
    vertex_share=0.7,
    checkpoint_every=400,
)


def varied(*, model: dict | None = None, **changes: object) -> TrainConfig:
    changed = dataclasses.replace(BASE.model, **(model or {}))
    return dataclasses.replace(BASE, model=changed, **changes)  # pyright: ignore[reportArgumentType]


def seen(**changes: object) -> dict:
    return {"inputs": dataclasses.replace(BASE.model.inputs, **changes)}  # pyright: ignore[reportArgumentType]


# Name: configuration and the datasets that are learned from.
VARIANTS: dict[str, tuple[TrainConfig, tuple[str, ...]]] = {
    "base": (BASE, ("data",)),
    "texels alone": (varied(vertex_share=0.0), ("data",)),
    "texels alone, world frame": (
        varied(vertex_share=0.0, model={"inputs": FeatureConfig("paper")}),
        ("data",),
    ),
    "adversarial": (varied(adversarial=True), ("data",)),
    "squared": (varied(loss="l2"), ("data",)),
    "by Muon": (varied(optimizer="muon"), ("data",)),
    "differences along edges": (varied(edge_share=0.5), ("data",)),
    "four scales": (varied(pyramid_levels=4), ("data",)),
    "one frame": (varied(model=seen(frames=1)), ("data",)),
    "no acceleration": (varied(model=seen(acceleration=False)), ("data",)),
    "no gravity": (varied(model=seen(gravity=False)), ("data",)),
    "no place": (varied(model=seen(position=False)), ("data",)),
    "neither gravity nor place": (varied(model=seen(gravity=False, position=False)), ("data",)),
    "and mirrored actions": (varied(mirror_augmentation=True), ("data",)),
    "and extra actions": (BASE, ("data", "extra")),
    "width 32": (varied(model={"width": 32}), ("data",)),
    "128 x 128": (varied(model={"resolution": 128}), ("data",)),
    "32 x 32": (varied(model={"resolution": 32}), ("data",)),
    "five frames": (varied(model=seen(frames=5)), ("data",)),
    "three frames, five apart": (varied(model=seen(stride=5)), ("data",)),
    "256 x 256": (varied(model={"resolution": 256}), ("data",)),
    "and slower actions": (BASE, ("data", "slow")),
    "other engine": (BASE, ("other",)),
}
# Left out unless asked for by --only: half an hour on two cores.
LONG = ("256 x 256",)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", default="runs/ours")
    for name in ("extra", "slow"):
        parser.add_argument(f"--{name}", default=f"runs/{name}")
    parser.add_argument("--other", default="runs/blender", help="the protocol by another engine")
    parser.add_argument("--runs", default="runs/ablations", help="where the runs are kept")
    parser.add_argument("--only", nargs="+", default=())
    parser.add_argument("--weights", action="store_true", help="leave them in the runs' folders")
    words = parser.parse_args()
    path = RESULTS / "ablations.json"
    rows = json.loads(path.read_text()) if path.is_file() else []
    tests = [s for root in (words.data, words.other) for s in sequences(root, "test")]
    if not tests:
        raise SystemExit(f"{words.data}: no test actions; build the dataset first.")
    wanted = [v for v in VARIANTS if (v in words.only if words.only else v not in LONG)]
    with Progress() as bars:
        for name in wanted:
            config, names = VARIANTS[name]
            roots = [getattr(words, n) for n in names]
            known = [s for root in roots for s in sequences(root, "train", "extra")]
            short = [root for root in roots if len(sequences(root, "train", "extra")) < 16]
            if short:
                bars.console.print(f"{name}: {', '.join(short)} isn't built (whole); left out.")
                continue
            engines = {s.meta[t]["engine"] for s in tests for t in s.offsets}
            told = all(
                any(r["variant"] == name and r["engine"] == e for r in rows) for e in engines
            )
            folder = pathlib.Path(words.runs) / name.replace(" ", "_")
            if told and not (words.weights and not (folder / "weights").is_dir()):
                continue
            bar = bars.add_task(name)
            jax.clear_caches()
            predictor = train(
                config,
                known,
                folder,
                steps=steps(words.data, config),
                report=lambda k, n, _, bar=bar: bars.update(bar, completed=k, total=n),
            )
            if words.weights:
                save_predictor(folder / "weights", predictor, name=folder.name)
            if told:
                continue
            log = [x for x in read_metrics(folder) if "loss" in x]
            rows = [r for r in rows if r["variant"] != name]
            rows += measure(name, network(predictor), tests)
            for r in rows:
                if r["variant"] == name:
                    r |= {
                        "inputs": config.model.inputs.channels,
                        "steps": log[-1]["step"],
                        "s_per_step": round(lap(log), 3),
                    }
            if not any(r["variant"] == "lbs" and r["engine"] in engines for r in rows):
                rows += measure("lbs", skinning(), tests)
            with atomic_write(path) as part:
                part.write_text(json.dumps(rows, indent=1) + "\n")
    with atomic_write(path.with_suffix(".md")) as part:
        part.write_text(table(rows) + "\n")


def sequences(root: str, *splits: str) -> list[Sequence]:
    return [read_sequence(f) for split in splits for f in list_sequences(root, split)]


def steps(data: str, config: TrainConfig) -> int:
    """As many for every variant as `base` takes."""
    frames = sum(s.motion.num_frames for s in sequences(data, "train"))
    return frames // config.batch * config.epochs


def lap(log: list[dict]) -> float:
    """Seconds a step: the median over the log, which starts anew when a run goes on."""
    laps = [
        (b["seconds"] - a["seconds"]) / (b["step"] - a["step"])
        for a, b in zip(log, log[1:], strict=False)
        if b["step"] > a["step"] and b["seconds"] > a["seconds"]
    ]
    return statistics.median(laps)


def measure(name: str, method: Method, tests: list[Sequence]) -> list[dict]:
    """Means over the test actions, a row for each engine and template."""
    errors: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for t in TEMPLATES:
        for s in tests:
            if t not in s.offsets or not usable_garment(s.meta[t]):
                continue
            answer = method(s.motion, t)
            reference = skinning()(s.motion, t).positions + s.offsets[t]
            error = vertex_error(answer.positions, reference).rmse_mm
            errors.setdefault((s.meta[t]["engine"], t), []).append((error, answer.ms_per_frame))
    return [
        {
            "variant": name,
            "engine": engine,
            "template": t,
            "actions": len(found),
            "rmse_vertices_mm": round(statistics.fmean(e for e, _ in found), 2),
            "ms_per_frame": round(statistics.median(ms for _, ms in found), 2),
        }
        for (engine, t), found in errors.items()
    ]


def table(rows: list[dict]) -> str:
    """A line for each engine and variant."""
    lines = [
        "| reference | variant | top, mm | bottom, mm | dress, mm | mean against base |",
        "|---|---|---|---|---|---|",
    ]
    for engine in dict.fromkeys(r["engine"] for r in rows):
        cells = {
            (r["variant"], r["template"]): r["rmse_vertices_mm"]
            for r in rows
            if r["engine"] == engine
        }
        for name in dict.fromkeys(v for v, _ in cells):
            found = [cells.get((name, t)) for t in TEMPLATES]
            both = [
                cells[name, t] / cells["base", t]
                for t in TEMPLATES
                if (name, t) in cells and ("base", t) in cells
            ]
            against = f"{100 * (statistics.fmean(both) - 1):+.1f} %" if both else ""
            shown = " | ".join("" if x is None else f"{x:.1f}" for x in found)
            lines.append(f"| {engine} | {name} | {shown} | {against} |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
