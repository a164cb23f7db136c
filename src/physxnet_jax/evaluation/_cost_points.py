"""Points of the diagram of error against time, from rows of `bench_networks`."""

import math
from collections.abc import Sequence

from ._cost import Cost


def cost_points(rows: Sequence[Cost]) -> list[tuple[str, str, float, float]]:
    """Points of the diagram: a panel for each number of garments, a line for each method."""
    panels = {r.garments for r in rows if r.method.startswith(("network", "guided"))}
    several = len({r.device for r in rows}) > 1
    out = []
    for r in rows:
        if math.isnan(r.rmse_mm) or (panels and r.garments not in panels) or _is_noise(r):
            continue
        name = r.method if r.precision == "float32" else f"{r.method} {r.precision}"
        # A network of another family isn't a size of the same one: it gets its own line.
        name = f"{name} (paper)" if r.size == "paper" else name
        if r.method.startswith(("network", "guided")):
            name += ", live" if r.batch == 1 else f", {r.batch} frames"
        if several:
            name += f", {r.device}"
        out.append((_panel(r), name, r.rmse_mm, r.ms_per_frame))
    return out


def noise_floors(rows: Sequence[Cost]) -> dict[str, float]:
    """Noise floor of each panel [mm]: the error of a perturbed simulation."""
    return {_panel(r): r.rmse_mm for r in rows if _is_noise(r) and not math.isnan(r.rmse_mm)}


def engine_times(rows: Sequence[Cost]) -> dict[str, dict[str, float]]:
    """Times of external engines [ms per frame], for each panel."""
    panels = {p[0] for p in cost_points(rows)}
    out: dict[str, dict[str, float]] = {}
    for r in rows:
        if r.method == "engine" and _panel(r) in panels:
            out.setdefault(_panel(r), {})[f"{r.size} (another cloth)"] = r.ms_per_frame
    return out


def _panel(row: Cost) -> str:
    return "one garment" if row.garments == 1 else f"{row.garments} garments"


def _is_noise(row: Cost) -> bool:
    return (row.method, row.size) == ("simulator", "perturbed")
