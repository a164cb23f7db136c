"""Network and skinning against the simulation on held-out actions: error beside time.

Command: python experiments/compare_methods.py --dataset runs/first/dataset
Cost:    about five minutes on two cores; with `--only punch` one.
Result:  experiments/results/compare_methods.json and .md; the README's table is
         that of `--only punch`. All errors are distances of template vertices from our
         own simulation, before the push-out; times are medians after warm-up, of the
         whole way from joint rotations to garment vertices, in the same run.
"""

import argparse
import dataclasses
import json
import pathlib
import statistics

from rich.console import Console

from physxnet_jax.data import list_sequences, read_sequence, skinned_cloth
from physxnet_jax.dressing import dress
from physxnet_jax.evaluation import vertex_error
from physxnet_jax.garment import TEMPLATES, template
from physxnet_jax.simulation import Scene, prepare_scene

OUT = pathlib.Path("experiments/results")
TIMED = "punch"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--dataset", type=pathlib.Path, default=pathlib.Path("runs/first/dataset"))
    parser.add_argument("--weights", default="first")
    parser.add_argument("--only", default="", help="one action; written as compare_NAME")
    args = parser.parse_args()
    console = Console()
    scenes = {t: prepare_scene(Scene((template(t),))) for t in TEMPLATES}
    rows = []
    for folder in list_sequences(args.dataset, "test"):
        if args.only and folder.name != args.only:
            continue
        s = read_sequence(folder)
        reference = {t: skinned_cloth(scenes[t], s.motion) + s.offsets[t] for t in TEMPLATES}
        for method in ("network", "lbs", "simulate"):
            if method == "simulate" and s.name != TIMED:
                continue
            for t in TEMPLATES:
                clip = dress(
                    s.motion,
                    [t],
                    method=method,
                    weights=args.weights,
                    include_body=False,
                    resolve=False,
                )
                error = vertex_error(clip.garments[0].positions, reference[t])
                warm = [x.warm_ms for x in clip.stages if x.warm_ms is not None]
                rows.append(
                    {
                        "action": s.name,
                        "template": t,
                        "method": method,
                        **dataclasses.asdict(error),
                        "ms_per_frame": warm[-1] if warm else None,
                        "inside_share": clip.inside_raw[t],
                    }
                )
                console.print(f"{s.name:15} {t:7} {method:9} {error.rmse_mm:7.2f} mm  {warm} ms")
    OUT.mkdir(parents=True, exist_ok=True)
    name = f"compare_{args.only or 'methods'}"
    (OUT / f"{name}.json").write_text(json.dumps(rows, indent=1))
    (OUT / f"{name}.md").write_text(markdown(rows))


def markdown(rows: list[dict]) -> str:
    """The tables as Markdown."""
    lines = [
        f"One action (`{TIMED}`), RMSE in mm of template vertices against the simulation, and"
        " milliseconds a frame:",
        "",
        "| method | top | bottom | dress | ms a frame (one garment) |",
        "|---|---|---|---|---|",
    ]
    for method in ("simulate", "network", "lbs"):
        mine = [r for r in rows if r["method"] == method and r["action"] == TIMED]
        cells = [f"{next(r['rmse_mm'] for r in mine if r['template'] == t):.1f}" for t in TEMPLATES]
        ms = statistics.median(r["ms_per_frame"] for r in mine)
        lines.append(f"| {method} | {' | '.join(cells)} | {ms:.1f} |")
    lines += ["", "All test actions, RMSE in mm, network / skinning:", ""]
    lines += ["| action | top | bottom | dress |", "|---|---|---|---|"]
    for action in dict.fromkeys(r["action"] for r in rows):
        cells = []
        for t in TEMPLATES:
            mine = {r["method"]: r for r in rows if r["action"] == action and r["template"] == t}
            pair = [mine[m]["rmse_mm"] for m in ("network", "lbs")]
            cells.append(f"{pair[0]:.1f} / {pair[1]:.1f}")
        lines.append(f"| {action} | {' | '.join(cells)} |")
    for m in ("network", "lbs"):
        mean = [
            statistics.fmean(r["rmse_mm"] for r in rows if r["template"] == t and r["method"] == m)
            for t in TEMPLATES
        ]
        lines.append(f"| mean, {m} | {' | '.join(f'{x:.1f}' for x in mean)} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
