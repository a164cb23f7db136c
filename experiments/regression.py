"""Records what the package computes, and compares two records.

Commands: python experiments/regression.py record runs/regression/before
          python experiments/regression.py record runs/regression/after
          python experiments/regression.py compare runs/regression/before runs/regression/after
Cost:     about ten minutes a record on two cores.
Result:   experiments/results/regression.json and .md, written by `compare`.

A record holds clips dressed by every method, values and gradients of `clothe`, the losses of
20 training steps and one evaluation row of each method. It goes through the command line, so
that Python names may change between two records. Arrays stay in the record's folder. A record
that was interrupted continues where it stopped.
"""

import argparse
import json
import os
import pathlib
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np

import physxnet_jax as px
from physxnet_jax.cli import main as physxnet

DATA = pathlib.Path(os.environ.get("PHYSXNET_DATA", "../shared"))
RESULTS = pathlib.Path(__file__).parent / "results"
CLIPS = {"walk_fast": "mocap/amc/002_01.amc", "salsa": "mocap/daz/060_12.bvh"}
GARMENTS = {
    "top": "top",
    "bottom": "bottom",
    "dress": "dress",
    "tee": "garments/tee.obj",
    "file_dress": "garments/F_Dress_01.obj",
}
FRAMES = 16
STEPS = 20
METHODS = (
    "lbs",
    "nearest",
    "mlp",
    "draft",
    "standard",
    "perturbed",
    "nano",
    "small",
    "base",
    "base+relax+push",
    "base+guided",
)
DATASET = """
engine = "physxnet"
"""
TRAINING = """
model = { resolution = 32, width = 8 }
epochs = 5
batch = 4
learning_rate = 1e-3
vertex_share = 0.7
"""
SUFFIX = ".toml"


def run(*words: object) -> None:
    """A command that has to succeed."""
    code = physxnet([str(w) for w in words])
    if code:
        raise SystemExit(f"physxnet {' '.join(map(str, words))} exited with {code}.")


def source(word: str) -> str:
    """A template, or a garment file where the data lies."""
    return word if "/" not in word else str(DATA / word)


def record_clips(folder: pathlib.Path) -> None:
    """Each garment on each clip by each method, and an outfit of two layers."""
    outfits = {name: [source(word)] for name, word in GARMENTS.items()}
    outfits["outfit"] = ["top", "bottom"]
    for clip, file in CLIPS.items():
        for method in ("network", "lbs", "simulate"):
            for name, wear in outfits.items():
                out = folder / f"{clip}-{method}-{name}.npz"
                if out.is_file():
                    continue
                words = ["dress", DATA / file, "--wear", *wear, "--method", method]
                run(*words, "--frames", FRAMES, "--start", 0.3, "-o", out, "--quiet")
    for name, wear in outfits.items():
        out = folder / f"walk_fast-simulate_command-{name}.npz"
        if not out.is_file():
            words = ["simulate", DATA / CLIPS["walk_fast"], "--wear", *wear]
            run(*words, "--frames", FRAMES, "--start", 0.3, "-o", out, "--quiet")


def record_layer(folder: pathlib.Path) -> None:
    """Values and gradients of `clothe`."""
    out = folder / "clothe.npz"
    if out.is_file():
        return
    motion = px.load_motion("punch", fps=30)
    rotations, root = motion.rotations[10:16], motion.root[10:16]
    arrays = {}
    mirrored = px.Inference(weights="nano", tta=True, strain_iterations=0)
    for name, inference in (("default", px.Inference()), ("mirrored", mirrored)):
        dresser = px.make_dresser(["top", "bottom", "dress"], inference=inference)

        def total(rotations, root, dresser=dresser):
            cloth = px.clothe(dresser, rotations, root, 30.0)
            each = [cloth[g] for g in ("top", "bottom", "dress")]
            return sum(jnp.sum(x * jnp.sin(7.0 * x)) for x in each), each

        (_, each), slopes = jax.jit(jax.value_and_grad(total, (0, 1), has_aux=True))(
            rotations, root
        )
        for garment, x in zip(("top", "bottom", "dress"), each, strict=True):
            arrays[f"{name}_{garment}"] = np.asarray(x)
        arrays[f"{name}_by_rotations"], arrays[f"{name}_by_root"] = map(np.asarray, slopes)
    np.savez(out, **arrays)


def record_training(folder: pathlib.Path) -> None:
    """A small dataset, the losses of training on it, and rows of errors."""
    for name, text in (("dataset", DATASET), ("training", TRAINING)):
        (folder / f"{name}{SUFFIX}").write_text(text)
    data, trained = folder / "dataset", folder / "run"
    words = ["dataset", "build", folder / f"dataset{SUFFIX}", "--out", data, "--quiet"]
    run(*words, "--mocap", DATA / "mocap", "--only", "run", "jogging")
    # The last step of a call is always logged.
    for step in range(1, STEPS + 1):
        words = ["train", folder / f"training{SUFFIX}", "--data", data, "--out", trained]
        run(*words, "--steps", step, "--quiet")
    run("evaluate", *METHODS, "--data", data, "--out", folder / "errors.json", "--quiet")


def arrays_of(folder: pathlib.Path) -> Iterator[tuple[str, str, np.ndarray]]:
    """Every float array of a record's npz files, by file and key."""
    for path in sorted(folder.glob("*.npz")):
        with np.load(path, allow_pickle=False) as file:
            for key in file.files:
                if np.issubdtype(file[key].dtype, np.floating) and file[key].ndim:
                    yield path.stem, key, file[key]


def losses_of(folder: pathlib.Path) -> dict[int, float]:
    lines = (folder / "run/metrics.jsonl").read_text().splitlines()
    return {x["step"]: x["loss"] for x in map(json.loads, lines) if "loss" in x}


def compare(before: pathlib.Path, after: pathlib.Path) -> list[dict]:
    """One row for each file of a record: largest difference, its bound, whether it holds."""
    after_arrays = {(f, k): x for f, k, x in arrays_of(after)}
    spread = {
        r["template"]: 1e-3 * r["rmse_vertices_mm"]
        for r in json.loads((before / "errors.json").read_text())
        if r["method"] in ("perturbed", "perturbed")
    }
    rows: dict[str, dict] = {}
    for file, key, x in arrays_of(before):
        y = after_arrays[file, key]
        difference = float(np.abs(x - y).max()) if x.shape == y.shape else np.inf
        bound = 1e-6
        if "by_" in key:
            # Relative, for slopes.
            difference, bound = difference / float(np.abs(x).max()), 1e-4
        elif "simulate" in file and difference and x.shape == y.shape and x.ndim == 3:
            early = float(np.abs(x[:3] - y[:3]).max())
            rmse = float(np.sqrt(np.mean(np.sum((x - y) ** 2, axis=-1))))
            difference, bound = (early, 1e-5) if early > 1e-5 else (rmse, max(spread.values()))
        label = f"{file} {key}" if file == "clothe" else file
        if label not in rows or difference > rows[label]["difference"]:
            rows[label] = {
                "record": label,
                "difference": difference,
                "bound": bound,
                "equal bits": bool(np.array_equal(x, y)),
            }
    a, b = losses_of(before), losses_of(after)
    worst = max(abs(a[s] - b[s]) / abs(a[s]) for s in a)
    rows["losses"] = {
        "record": f"losses of {len(a)} steps, relative",
        "difference": worst,
        "bound": 1e-4,
        "equal bits": a == b,
    }
    e, f = (
        [r["rmse_vertices_mm"] for r in json.loads((folder / "errors.json").read_text())]
        for folder in (before, after)
    )
    rows["errors"] = {
        "record": f"RMSE [mm] of {len(e)} evaluation rows",
        "difference": max(abs(x - y) for x, y in zip(e, f, strict=True)),
        # Five digits are kept.
        "bound": 2e-3,
        "equal bits": e == f,
    }
    return [r | {"holds": bool(r["difference"] <= r["bound"])} for r in rows.values()]


def table(rows: list[dict]) -> str:
    lines = [
        "| record | largest difference | bound | equal bits | holds |",
        "|---|---|---|---|---|",
    ]
    for r in rows:
        yes = ["no", "yes"]
        lines.append(
            f"| {r['record']} | {r['difference']:.1e} | {r['bound']:.1e} |"
            f" {yes[r['equal bits']]} | {yes[r['holds']]} |"
        )
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("record", "compare"))
    parser.add_argument("folders", nargs="+", type=pathlib.Path)
    words = parser.parse_args()
    if words.what == "record":
        (folder,) = words.folders
        folder.mkdir(parents=True, exist_ok=True)
        for part in (record_layer, record_clips, record_training):
            part(folder)
            print(f"{part.__name__}: done", flush=True)  # noqa: T201
        return
    rows = compare(*words.folders)
    (RESULTS / "regression.json").write_text(json.dumps(rows, indent=1) + "\n")
    (RESULTS / "regression.md").write_text(table(rows))
    print(table(rows))  # noqa: T201
    if not all(r["holds"] for r in rows):
        raise SystemExit("not the same")


if __name__ == "__main__":
    main()
