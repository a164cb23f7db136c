"""Garments, fabrics and bodies that no network has seen, against simulations of the same.

Command: python experiments/unseen.py --data runs/clothes/held_out
         --files FOLDER (default: garments in $PHYSXNET_DATA or ../shared)
         --weights base (default)
Cost:    half an hour on two cores; goes on where it was stopped.
Result:  experiments/results/unseen.json and .md: RMSE of skinning, network and guided simulation
         to a simulation of that very garment on that body, strength of folds over its own and
         share of visible skin, by garment, fabric, shape and action.
"""

import argparse
import json
import os
import pathlib
import statistics
from collections.abc import Iterator

import numpy as np
from rich.progress import track

from physxnet_jax.data import Sequence, list_sequences, load_action, read_protocol, read_sequence
from physxnet_jax.dressing import Inference, dress
from physxnet_jax.evaluation import evaluate, fold_strength, method_by_name, vertex_error
from physxnet_jax.files import atomic_write, write_json
from physxnet_jax.garment import KINDS, TEMPLATES, Template, load_garment, parse_wear
from physxnet_jax.motion import Motion

RESULTS = pathlib.Path(__file__).parent / "results"
# Files: two actions of the test split, one soft and one abrupt.
ACTIONS = ("walking", "punch")
FRAMES = 60
FILES = ("tee", "longsleeve", "pants", "F_Dress_01")
METHODS = ("skinning", "network", "guided")


def held_out(sequence: Sequence, methods: dict) -> Iterator[dict]:
    """Rows of the garments of an outfit."""
    outfit = sequence.outfit
    assert outfit is not None
    words = {g.template: w for w, g in zip(outfit.wear, outfit.garments().values(), strict=True)}
    names: list[Template] = [t for t in TEMPLATES if t in sequence.offsets]
    for name in names:
        item = parse_wear(words[name])
        fabric = item.fabric or KINDS[item.name].fabric
        for row in evaluate(methods, [sequence], templates=(name,)):
            yield {
                "garment": words[name],
                "fabric": fabric,
                "shape": " ".join(outfit.shape) or "default",
                "action": sequence.motion.name,
                "method": row.method,
                "rmse_mm": row.rmse_vertices_mm,
                "folds": row.fold_strength,
                "visible_skin": row.visible_skin,
            }


def of_file(path: pathlib.Path, weights: str, action: str, motion: Motion) -> Iterator[dict]:
    """Rows of a garment file."""
    garment = load_garment(path)[0]
    cloth = {}
    for method in ("simulate", "lbs", "network", "guided"):
        clip = dress(
            motion,
            [garment],
            method=method,
            inference=Inference(weights=weights, collisions=method != "lbs"),
            include_body=False,
        )
        cloth[method] = np.asarray(clip.garments[0].positions)
    faces, truth = np.asarray(garment.mesh.faces), cloth.pop("simulate")
    for label, x in zip(METHODS, cloth.values(), strict=True):
        yield {
            "garment": path.name,
            "fabric": "cotton",
            "shape": "default",
            "action": action,
            "method": label,
            "rmse_mm": vertex_error(x, truth).rmse_mm,
            "folds": fold_strength(faces, x) / fold_strength(faces, truth),
        }


def table(rows: list[dict]) -> str:
    """A line for each garment and body: means over actions."""
    lines = [
        "| garment | fabric | shape | actions | skinning, mm | network, mm | guided, mm |"
        " guided over skinning | folds | visible skin, % |",
        "|---" * 10 + "|",
    ]
    groups: dict[tuple, list[dict]] = {}
    for r in rows:
        groups.setdefault((r["garment"], r["fabric"], r["shape"]), []).append(r)
    for key, mine in groups.items():

        def mean(quantity: str, method: str, mine: list[dict] = mine) -> float:
            return statistics.fmean(r[quantity] for r in mine if r["method"] == method)

        errors = [mean("rmse_mm", m) for m in METHODS]
        skin = f"{100 * mean('visible_skin', 'guided'):.3f}" if "visible_skin" in mine[0] else ""
        cells = [*key, str(len({r["action"] for r in mine})), *(f"{e:.1f}" for e in errors)]
        cells += [f"{errors[2] / errors[0]:.2f}", f"{mean('folds', 'guided'):.2f}", skin]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    shared = pathlib.Path(os.environ.get("PHYSXNET_DATA", "../shared"))
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--data", required=True)
    parser.add_argument("--files", type=pathlib.Path, default=shared / "garments")
    parser.add_argument("--weights", default="base")
    parser.add_argument("--out", type=pathlib.Path, default=RESULTS / "unseen.json")
    options = parser.parse_args()
    path = options.out
    rows = json.loads(path.read_text()) if path.is_file() else []
    known = {(r["garment"], r["shape"], r["action"]) for r in rows}
    names = ("lbs", f"{options.weights}+relax+push", f"{options.weights}+guided")
    methods = dict(zip(METHODS, (method_by_name(n) for n in names), strict=True))
    for folder in track(list_sequences(options.data, "test"), description="outfits"):
        sequence = read_sequence(folder)
        assert sequence.outfit is not None
        shape = " ".join(sequence.outfit.shape) or "default"
        if all((w, shape, sequence.motion.name) in known for w in sequence.outfit.wear):
            continue
        rows += held_out(sequence, methods)
        write_json(path, rows)
    clips = {}
    for action in read_protocol(shared / "mocap"):
        if action.name in ACTIONS and action.split == "test":
            m = load_action(shared / "mocap", action)
            clips[action.name] = Motion(m.rotations[:FRAMES], m.root[:FRAMES], m.fps, m.name)
    for file in track([options.files / f"{n}.obj" for n in FILES], description="files"):
        for action, motion in clips.items():
            if (file.name, "default", action) not in known:
                rows += of_file(file, options.weights, action, motion)
                write_json(path, rows)
    with atomic_write(path.with_suffix(".md")) as part:
        part.write_text(table(rows))


if __name__ == "__main__":
    main()
