"""Takes results of a CUDA machine over into the tables.

Command: python experiments/cuda/report.py FOLDER --date 2026-11-27
Cost:    a second.
Result:  experiments/results/cuda.json, where each part's newest rows stand with card and date, and
         cuda.md, the table of simulated people for docs/simulation.md. FOLDER is what `run.sh`
         left in $OUT.
"""

import argparse
import datetime
import json
import pathlib
import sys
from typing import Any

from physxnet_jax.files import atomic_write, write_json

RESULTS = pathlib.Path(__file__).parents[1] / "results"


def merged(stored: dict[str, Any], found: dict[str, Any], date: str) -> dict[str, Any]:
    """Parts of earlier runs, replaced by those of a new one."""
    cards = [r["card"] for r in found.get("tests", []) if "card" in r]
    card = cards[0] if cards else "unknown"
    new = {part: {"date": date, "card": card, "rows": rows} for part, rows in found.items()}
    return stored | new


def people_table(parts: dict[str, Any]) -> str:
    """Time, floor and error by the number of people."""
    part = parts["simulator"]
    lines = [
        f"{part['card']}, {part['date']}",
        "",
        "| preset | people | ms a person and frame | floor ms | times its floor"
        " | from reference mm | first block s |",
        "|---|---|---|---|---|---|---|",
    ]
    for r in (r for r in part["rows"] if "preset" in r):
        times = r["ms_per_person_frame"] / r["floor_ms"]
        lines.append(
            f"| {r['preset']} | {r['people']} | {r['ms_per_person_frame']:.2f} |"
            f" {r['floor_ms']:.2f} | {times:.0f} | {r['rms_from_reference_mm']:.1f} |"
            f" {r['first_block_s']:.0f} |"
        )
    return "\n".join(lines) + "\n"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=pathlib.Path)
    parser.add_argument("--date", default=datetime.date.today().isoformat())
    options = parser.parse_args()
    path = RESULTS / "cuda.json"
    stored = json.loads(path.read_text()) if path.is_file() else {}
    found = {}
    for name in ("results.json", "learned.json"):
        if (options.folder / name).is_file():
            found |= json.loads((options.folder / name).read_text())
    parts = merged(stored, found, options.date)
    write_json(path, parts)
    with atomic_write(RESULTS / "cuda.md") as part:
        part.write_text(people_table(parts))
    return 0


if __name__ == "__main__":
    sys.exit(main())
