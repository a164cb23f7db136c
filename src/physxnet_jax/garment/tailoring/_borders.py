"""Borders of a garment's panels, drawn on the charts."""

import dataclasses
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from ._charts import HEIGHT, REACH, ChartName, Charts
from ._curves import centre_point, centre_points, centre_row, level_curve, seam_points, seam_row
from ._form import WAIST
from ._measures import Kind
from ._outline import SKIRT_QUARTER

Levels = Mapping[str, float]
"""Where a garment ends on the default shape: ``hem`` [m], ``reach`` of the sleeve [m], depth of
the ``neckline`` [m]."""
STRAPLESS_TOP = 0.37
"""Height of the upper border of strapless garments on the default shape [m]."""
# Where the armhole crosses the shoulder, from the joint along the arm [m].
_SHOULDER = 0.02
_HALVES: tuple[tuple[ChartName, int], ...] = (("front", 0), ("back", 2))


@dataclasses.dataclass(frozen=True, eq=False)
class Side:
    """One side of a panel's border.

    Attributes:
        name: Its name; sides of the same name are sewn together.
        points: Places on the panel's chart, in the border's direction (anticlockwise).
        backwards: The side it is sewn to runs the same way round.
    """

    name: str
    points: Float[np.ndarray, "points 2"]
    backwards: bool = False


def borders(kind: Kind, levels: Levels, charts: Charts) -> dict[str, tuple[ChartName, list[Side]]]:
    """Borders of the panels of the left half of a garment.

    Args:
        kind: The kind of garment.
        levels: Where it ends.
        charts: The charts.

    Returns:
        Chart and sides of each panel by name.
    """
    out: dict[str, tuple[ChartName, list[Side]]] = {}
    if kind.style in ("top", "dress"):
        out |= _top(kind, levels, charts)
    elif kind.style in ("strapless", "strapless-dress"):
        out |= _strapless(kind, levels, charts)
    elif kind.style == "trousers":
        out |= _trousers(levels, charts)
    if kind.style in ("skirt", "dress", "strapless-dress"):
        out |= _skirt(kind, levels)
    return out


def _line(a: np.ndarray, b: np.ndarray, count: int = 40) -> np.ndarray:
    return a + np.linspace(0.0, 1.0, count)[:, None] * (b - a)


def _along(seam: np.ndarray, start: float, end: float) -> np.ndarray:
    """A seam between two of its rows, which keeps the rows in between."""
    inner = np.arange(np.ceil(min(start, end) + 1e-6), np.floor(max(start, end) - 1e-6) + 1)
    rows = np.concatenate([[start], inner if end > start else inner[::-1], [end]])
    fine = np.interp(np.linspace(0, len(rows) - 1, 4 * len(rows)), np.arange(len(rows)), rows)
    return seam_points(seam, fine)


def _hem_of_trunk(kind: Kind, levels: Levels) -> float:
    return WAIST[kind.style] if kind.style.endswith("dress") else levels["hem"]


def _trunk_hem(kind: Kind, levels: Levels, charts: Charts):
    """The corners of the hem of a top, and its name."""
    height = _hem_of_trunk(kind, levels)
    low = charts.side[: charts.armpit + 1]
    row = seam_row(charts, low, HEIGHT, height)
    outer = seam_points(low, np.array([row]))[0]
    middle = np.concatenate([centre_point(charts, n, height) for n in ("front", "back")])
    return row, outer, middle, "waist" if kind.style.endswith("dress") else "hem"


def _top(kind: Kind, levels: Levels, charts: Charts) -> dict[str, tuple[ChartName, list[Side]]]:
    row, outer, middle, hem = _trunk_hem(kind, levels, charts)
    reach = levels["reach"]
    high = charts.side[charts.armpit :]
    lower = charts.armpit + seam_row(charts, high, REACH, reach)
    upper = seam_row(charts, charts.over, REACH, reach)
    neck = neck_row(kind, charts)
    shoulder = seam_row(charts, charts.over, REACH, _SHOULDER)
    side = _along(charts.side, row, float(charts.armpit))
    under = _along(charts.side, float(charts.armpit), lower)
    over = _along(charts.over, upper, shoulder)
    top = _along(charts.over, shoulder, neck)
    out: dict[str, tuple[ChartName, list[Side]]] = {}
    for name, c in _HALVES:
        chart, cut = charts.chart(name), slice(c, c + 2)
        corner = top[-1, cut]
        depth = levels["neckline"] if name == "front" else kind.back
        collar = np.array([0.0, corner[1] - depth])
        angle = np.linspace(0.0, np.pi / 2, 40)
        power = 2.0 / kind.round
        line = np.column_stack(
            [corner[0] * np.cos(angle) ** power, corner[1] - depth * np.sin(angle) ** power]
        )
        armhole = level_curve(chart, REACH, side[-1, cut], top[0, cut])
        out[name] = (
            name,
            [
                Side(f"{hem} {name}", level_curve(chart, HEIGHT, middle[cut], outer[cut])),
                Side("side", side[:, cut]),
                Side(f"armhole {name}", armhole),
                Side("shoulder", top[:, cut]),
                Side(f"neckline {name}", line),
                Side(f"middle {name}", _line(collar, middle[cut])),
            ],
        )
        out[f"sleeve {name}"] = (
            name,
            [
                Side("under", under[:, cut]),
                Side(f"cuff {name}", level_curve(chart, REACH, under[-1, cut], over[0, cut])),
                Side("over", over[:, cut]),
                Side(f"armhole {name}", armhole[::-1], backwards=True),
            ],
        )
    return out


def neck_row(kind: Kind, charts: Charts) -> float:
    """The row of the shoulder seam where the neckline begins."""
    p = 0.5 * (charts.over[:, :2] + charts.over[:, 2:])
    from_neck = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(p[::-1], axis=0), axis=1))])
    return float(len(p) - 1 - np.interp(kind.neck, from_neck, np.arange(len(p))))


def _strapless(
    kind: Kind, levels: Levels, charts: Charts
) -> dict[str, tuple[ChartName, list[Side]]]:
    row, outer, middle, hem = _trunk_hem(kind, levels, charts)
    top = STRAPLESS_TOP
    low = charts.side[: charts.armpit + 1]
    up = seam_row(charts, low, HEIGHT, top)
    side = _along(charts.side, row, up)
    out: dict[str, tuple[ChartName, list[Side]]] = {}
    for name, c in _HALVES:
        chart, cut = charts.chart(name), slice(c, c + 2)
        high = centre_point(charts, name, top)
        out[name] = (
            name,
            [
                Side(f"{hem} {name}", level_curve(chart, HEIGHT, middle[cut], outer[cut])),
                Side("side", side[:, cut]),
                Side(f"top {name}", level_curve(chart, HEIGHT, side[-1, cut], high)),
                Side(f"middle {name}", _line(high, middle[cut])),
            ],
        )
    return out


def _trousers(levels: Levels, charts: Charts) -> dict[str, tuple[ChartName, list[Side]]]:
    waist, hem = WAIST["trousers"], levels["hem"]
    low = charts.side[: charts.armpit + 1]
    up, down = (seam_row(charts, low, HEIGHT, y) for y in (waist, hem))
    inner = seam_row(charts, charts.inseam, HEIGHT, hem)
    side = _along(charts.side, down, up)
    inseam = _along(charts.inseam, 0.0, inner)
    middle = np.concatenate([centre_point(charts, n, waist) for n in ("front", "back")])
    out: dict[str, tuple[ChartName, list[Side]]] = {}
    for name, c in _HALVES:
        chart, cut = charts.chart(name), slice(c, c + 2)
        rows = np.linspace(centre_row(charts, name, waist), len(charts.middles[name]) - 1, 80)
        down = centre_points(charts, name, rows)
        out[name] = (
            name,
            [
                Side(f"middle {name}", down),
                Side("inseam", inseam[:, cut]),
                Side(f"hem {name}", level_curve(chart, HEIGHT, inseam[-1, cut], side[0, cut])),
                Side("side", side[:, cut]),
                Side(f"waist {name}", level_curve(chart, HEIGHT, side[-1, cut], middle[cut])),
            ],
        )
    return out


def _skirt(kind: Kind, levels: Levels) -> dict[str, tuple[ChartName, list[Side]]]:
    top, hem, q = WAIST[kind.style], levels["hem"], SKIRT_QUARTER
    sewn = kind.style != "skirt"
    out: dict[str, tuple[ChartName, list[Side]]] = {}
    for name, middle in (("front", 0.0), ("back", 2 * q)):
        # The back is drawn mirrored, so that both borders run the same way round.
        corners = [np.array([middle, hem]), np.array([q, hem]), np.array([q, top])]
        corners.append(np.array([middle, top]))
        a, b, c, d = corners
        out[f"skirt {name}"] = (
            "skirt",
            [
                Side(f"hem {name}", _line(a, b)),
                Side("skirt side", _line(b, c)),
                Side(f"waist {name}", _line(c, d), backwards=sewn),
                Side(f"skirt middle {name}", _line(d, a)),
            ],
        )
    return out
