"""Draws the tailor's charts and the patterns of every kind at its usual measures, and stores them.

Command: python experiments/build_tailor.py [--cuts]
Cost:    four minutes; with --cuts, which cuts from the patterns that are stored, two.
Result:  src/physxnet_jax/garment/assets/charts_cc0.npz, patterns_cc0.npz and cuts_cc0.npz, the same
         bytes with the same library versions, and the table of kinds in docs/garments.md.
"""

import argparse
import pathlib

import numpy as np
from rich.progress import track

from physxnet_jax.body import load_body
from physxnet_jax.garment.tailoring import (
    KINDS,
    MEASURES,
    build_charts,
    cut_usual,
    draw_usual_pattern,
    measure_usual_arm,
    stored_arrays,
)

OUT = pathlib.Path("src/physxnet_jax/garment/assets")


def write(name: str, arrays: dict[str, np.ndarray]) -> None:
    part = OUT / "part.npz"
    np.savez_compressed(part, allow_pickle=False, **arrays)
    part.replace(OUT / name)
    print(f"{OUT / name}: {(OUT / name).stat().st_size / 1e6:.2f} MB")  # noqa: T201


def kinds_table() -> str:
    """Kinds of garments with their measures: the default, and the range."""
    lines = [
        f"| kind | | fabric | {' | '.join(MEASURES)} |",
        f"|---|---|---|{'---|' * len(MEASURES)}",
    ]
    for name, kind in KINDS.items():
        cells = [
            f"{r.default:g} ({r.low:g} to {r.high:g})" if (r := kind.ranges.get(m)) else ""
            for m in MEASURES
        ]
        lines.append(f"| `{name}` | {kind.summary} | {kind.fabric} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def draw() -> None:
    """Draws the charts and the patterns."""
    write("charts_cc0.npz", build_charts(load_body()))
    patterns: dict[str, np.ndarray] = {"usual_arm": np.asarray(measure_usual_arm())}
    for name in track(KINDS, description="patterns"):
        patterns |= draw_usual_pattern(name)
    write("patterns_cc0.npz", patterns)
    stored_arrays.cache_clear()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cuts", action="store_true", help="keep the charts and the patterns")
    if not parser.parse_args().cuts:
        draw()
    cuts: dict[str, np.ndarray] = {}
    for name in track(KINDS, description="cuts"):
        cuts |= cut_usual(name)
    write("cuts_cc0.npz", cuts)
    page = pathlib.Path("docs/garments.md")
    before, mark, rest = page.read_text().partition("<!-- begin tailor -->\n")
    end = rest[rest.index("<!-- end tailor -->") :]
    page.write_text(before + mark + kinds_table() + end)


if __name__ == "__main__":
    main()
