"""The paper's experiment: every number and figure of docs/reproduction.md.

Command: python experiments/reproduce.py --data runs/ours (and --data runs/blender, if built)
Cost:    16 minutes on two cores for four methods (penetration takes most of it); goes
         on where it was stopped.
Result:  experiments/results/test_errors.json, .md, _vertices.png and _texels.png, the
         tables between the marks of docs/reproduction.md and README.md, and the measured
         table in the cards of the packaged weights. Datasets are built by `physxnet dataset
         build experiments/configs/dataset_physxnet.py --out runs/ours`, the weights `local`
         and `paper` by experiments/configs.
"""

import argparse
import json
import pathlib
import re
import statistics

from physxnet_jax.cli import main as physxnet
from physxnet_jax.evaluation import ActionError, error_tables, means, summary_table
from physxnet_jax.files import whole_file
from physxnet_jax.garment import TEMPLATES

ROOT = pathlib.Path(__file__).parents[1]
OUT = ROOT / "experiments/results/test_errors.json"
METHODS = ("lbs", "nearest", "mlp", "local", "local+push", "paper", "draft", "noise")
NETWORKS = ("local", "paper")
SOFT = ("moon walk", "balancing", "walking")
ABRUPT = ("strong gesture", "jump", "punch")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", action="append", default=[], help="datasets; none: tables alone")
    parser.add_argument("--learn-from", default="runs/ours", help="of nearest and mlp")
    parser.add_argument("--methods", nargs="+", default=METHODS)
    words = parser.parse_args()
    for data in words.data:
        where = ["--data", data, "--learn-from", words.learn_from, "--out", str(OUT)]
        code = physxnet(["evaluate", *words.methods, *where])
        if code:
            raise SystemExit(code)
    rows = [ActionError(**r) for r in json.loads(OUT.read_text())]
    blocks = {"summary": summary_table(rows), "errors": error_tables(rows), "claims": claims(rows)}
    for path in (ROOT / "docs/reproduction.md", ROOT / "README.md"):
        text = path.read_text()
        for name, block in blocks.items():
            mark = re.compile(rf"(<!-- begin {name} -->\n).*?(<!-- end {name} -->)", re.S)
            text = mark.sub(lambda m, b=block: f"{m[1]}{b.strip()}\n{m[2]}", text)
        with whole_file(path) as part:
            part.write_text(text)
    for name in NETWORKS:
        note_measured(name, rows)


def note_measured(name: str, rows: list[ActionError]) -> None:
    """Writes the means of packaged weights into their card."""
    path = ROOT / "src/physxnet_jax/io/weights" / name / "card.json"
    if not path.is_file():
        return
    card = json.loads(path.read_text())
    card["measured"] = [
        {
            "reference": engine,
            "template": t,
            "rmse_vertices_mm": round(found["rmse_vertices_mm"], 2),
            "rmse_vertices_mm_lbs": round(plain["rmse_vertices_mm"], 2),
        }
        for engine in dict.fromkeys(r.engine for r in rows)
        for t in TEMPLATES
        if (found := means(rows, name, t, engine)) and (plain := means(rows, "lbs", t, engine))
    ]
    with whole_file(path) as part:
        part.write_text(json.dumps(card, indent=1))


def claims(rows: list[ActionError]) -> str:
    """The paper's claims beside what came out here."""
    lines = ["| engine | network | claim | measured | holds |", "|---|---|---|---|---|"]
    for engine in dict.fromkeys(r.engine for r in rows):
        mine = {
            (r.method, r.template, r.action): r.rmse_vertices_mm for r in rows if r.engine == engine
        }
        actions = sorted({a for _, _, a in mine})
        for method in NETWORKS:
            if not any(m == method for m, _, _ in mine):
                continue

            def mean(name: str, these=actions, method=method, mine=mine) -> float:
                found = [mine[method, name, a] for a in these if (method, name, a) in mine]
                return statistics.fmean(found)

            cells = [k for k in mine if k[0] == method and ("lbs", *k[1:]) in mine]
            wins = sum(mine[k] < mine["lbs", *k[1:]] for k in cells)
            top, bottom, dress = (mean(t) for t in TEMPLATES)
            soft, abrupt = (
                statistics.fmean(mean(t, these) for t in TEMPLATES) for these in (SOFT, ABRUPT)
            )
            said = [
                ("better than skinning", f"{wins} of {len(cells)} cells", wins == len(cells)),
                (
                    "top and bottom alike (within a quarter)",
                    f"{top:.1f} and {bottom:.1f} mm",
                    abs(top - bottom) < 0.25 * max(top, bottom),
                ),
                (
                    "dress about twice (1.5 to 2.5 times)",
                    f"{2 * dress / (top + bottom):.2f} times",
                    1.5 <= 2 * dress / (top + bottom) <= 2.5,
                ),
                (
                    "soft actions lower than abrupt ones",
                    f"{soft:.1f} and {abrupt:.1f} mm",
                    soft < abrupt,
                ),
            ]
            lines += [
                f"| {engine} | {method} | {claim} | {value} | {'yes' if holds else 'no'} |"
                for claim, value, holds in said
            ]
    return "\n".join(lines)


if __name__ == "__main__":
    main()
