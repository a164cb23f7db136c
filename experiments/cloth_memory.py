"""How long does cloth remember? The same simulation, begun in the middle of an action.

Command: python experiments/cloth_memory.py --data runs/ours
Cost:    about four minutes on two cores; goes on where it was stopped.
Result:  experiments/results/cloth_memory.json and .md, shown in docs/reproduction.md: RMSE
         over vertices between a simulation begun in the middle of a test action and the one
         begun at its start, by the time since the later beginning, beside the network and
         skinning on the same frames; means of the actions.

Both simulations see the same motion from the middle on. What they differ by is decided by what
was before: no method that looks at a few frames of the body can know it. The network sees five
frames, a sixth of a second.
"""

import argparse
import json
import pathlib
import statistics

from rich.progress import track

from physxnet_jax.data import list_sequences, read_sequence
from physxnet_jax.evaluation import Simulator, network, skinning, vertex_error
from physxnet_jax.files import whole_file
from physxnet_jax.garment import TEMPLATES
from physxnet_jax.io import load_predictor, read_card
from physxnet_jax.motion import Motion

RESULTS = pathlib.Path(__file__).parent / "results"
# Seconds since the later beginning.
SPANS = ((0.0, 0.5), (0.5, 1.0), (1.0, 2.0), (2.0, 60.0))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", default="runs/ours")
    parser.add_argument("--weights", default="local")
    words = parser.parse_args()
    path = RESULTS / "cloth_memory.json"
    rows = json.loads(path.read_text()) if path.is_file() else []
    folders = list_sequences(words.data, "test")
    if not folders:
        raise SystemExit(f"{words.data}: no test actions; build the dataset first.")
    plain, learned = skinning(), network(load_predictor(words.weights))
    card = read_card(words.weights)["sha256"][:12]
    again = Simulator("standard")
    jobs = [(t, f) for t in TEMPLATES for f in folders]
    for name, folder in track(jobs, description="actions"):
        told = read_sequence(folder)
        have = {r["from_s"]: r for r in rows if (r["action"], r["template"]) == (told.name, name)}
        if have and all(r.get("weights") == card for r in have.values()):
            continue
        motion, middle = told.motion, told.motion.num_frames // 2
        late = Motion(motion.rotations[middle:], motion.root[middle:], motion.fps, motion.name)
        skinned = plain(motion, name).positions
        answers = {"network": learned(motion, name).positions[middle:]}
        if not have:
            # Of other weights the network alone is asked anew.
            answers["begun in the middle"] = again(late, name).positions
            answers["skinning"] = skinned[middle:]
        reference = (skinned + told.offsets[name])[middle:]
        for first, last in SPANS:
            a, b = (round(s * motion.fps) for s in (first, last))
            if a >= late.num_frames:
                continue
            if first not in have:
                have[first] = {"action": told.name, "template": name, "from_s": first, "to_s": last}
                rows.append(have[first])
            have[first] |= {
                k: vertex_error(x[a:b], reference[a:b]).rmse_mm for k, x in answers.items()
            } | {"weights": card}
        with whole_file(path) as part:
            part.write_text(json.dumps(rows, indent=1) + "\n")
    with whole_file(path.with_suffix(".md")) as part:
        part.write_text(table(rows) + "\n")
    print(table(rows))  # noqa: T201


def table(rows: list[dict]) -> str:
    names = ("begun in the middle", "network", "skinning")
    lines = [
        f"| garment | seconds since | actions | {', mm | '.join(names)}, mm |",
        "|---|---|---|" + "---|" * len(names),
    ]
    for name in TEMPLATES:
        for first, last in SPANS:
            span = [r for r in rows if (r["template"], r["from_s"]) == (name, first)]
            if not span:
                continue
            cells = " | ".join(f"{statistics.fmean(r[k] for r in span):.1f}" for k in names)
            until = f"{first:g} to {last:g}" if (first, last) != SPANS[-1] else f"over {first:g}"
            lines.append(f"| {name} | {until} | {len(span)} | {cells} |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
