"""Curves on the charts: along seams, at heights, and around the body."""

import dataclasses
import functools

import numpy as np
from jaxtyping import Float, Int

from ._charts import HEIGHT, REACH, Chart, ChartName, Charts, load_charts
from ._grid import spline
from ._outline import SKIRT_QUARTER

# Points of a quarter of a ring.
_SAMPLES = 16
# Heights of the rings around trunk, leg and skirt, and their distances along the arm [m].
TORSO_LEVELS = np.linspace(-0.06, 0.37, 21)
LEG_LEVELS = np.linspace(-0.74, -0.14, 18)
ARM_LEVELS = np.linspace(0.10, 0.45, 12)
SKIRT_LEVELS = np.linspace(-0.76, 0.22, 30)


def seam_points(
    seam: Float[np.ndarray, "rows 4"], rows: Float[np.ndarray, " points"]
) -> Float[np.ndarray, "points 4"]:
    """Points of a seam at fractions of its rows."""
    at = np.arange(len(seam))
    return np.column_stack([np.interp(rows, at, seam[:, k]) for k in range(4)])


def seam_row(charts: Charts, seam: Float[np.ndarray, "rows 4"], field: int, value: float) -> float:
    """The row of a seam at which a field has a value; the nearest end if it has it nowhere."""
    along = 0.5 * (charts.front.field(seam[:, :2], field) + charts.back.field(seam[:, 2:], field))
    order = 1.0 if along[-1] > along[0] else -1.0
    rising = np.maximum.accumulate(order * along)
    return float(np.interp(order * value, rising, np.arange(len(seam))))


def centre_row(charts: Charts, name: ChartName, height: float) -> float:
    """The row of the middle of front or back at a height."""
    middle = charts.middles[name]
    falling = np.minimum.accumulate(charts.chart(name).field(middle, HEIGHT))
    return float(np.interp(-height, -falling, np.arange(len(middle))))


def centre_points(
    charts: Charts, name: ChartName, rows: Float[np.ndarray, " points"]
) -> Float[np.ndarray, "points 2"]:
    """Points in the middle of front or back at fractions of its rows."""
    middle = charts.middles[name]
    at = np.arange(len(middle))
    return np.column_stack([np.interp(rows, at, middle[:, k]) for k in range(2)])


def centre_point(charts: Charts, name: ChartName, height: float) -> Float[np.ndarray, "2"]:
    """The point in the middle of front or back at a height."""
    return centre_points(charts, name, np.array([centre_row(charts, name, height)]))[0]


def level_curve(
    chart: Chart,
    field: int,
    start: Float[np.ndarray, "2"],
    end: Float[np.ndarray, "2"],
    count: int = 40,
) -> Float[np.ndarray, "points 2"]:
    """The curve between two points on which a field goes evenly from one's value to the other's."""
    p = start + np.linspace(0.0, 1.0, count)[:, None] * (end - start)
    ends = chart.field(np.stack([start, end]), field)
    goal = np.linspace(ends[0], ends[1], count)
    step = 1e-4
    for _ in range(8):
        slope = np.column_stack(
            [
                (chart.field(p + d, field) - chart.field(p - d, field)) / (2 * step)
                for d in (np.array([step, 0.0]), np.array([0.0, step]))
            ]
        )
        gap = goal - chart.field(p, field)
        move = gap[:, None] * slope / np.maximum((slope**2).sum(axis=1, keepdims=True), 1e-3)
        p = p + np.where(
            ((np.arange(count) > 0) & (np.arange(count) < count - 1))[:, None], move, 0
        )
    return p


@dataclasses.dataclass(frozen=True, eq=False)
class Rings:
    """Closed curves around the trunk, a limb or a skirt, in pieces of front and back.

    Attributes:
        levels: Height or distance along the arm on the default shape [m], ascending.
        nodes: Nodes of the charts around each point, shape [rings, pieces, points, 16].
        weights: Their weights, of the same shape.
        fields: Fields of the charts, shape [rings, pieces, points, 4].
        pair: All pieces make one ring; otherwise one for each side.
        skirt: The points lie on the skirt's chart.
    """

    levels: Float[np.ndarray, " rings"]
    nodes: Int[np.ndarray, "rings pieces points 16"]
    weights: Float[np.ndarray, "rings pieces points 16"]
    fields: Float[np.ndarray, "rings pieces points 4"]
    pair: bool
    skirt: bool


def _rings(charts: Charts, levels, pieces: dict[ChartName, np.ndarray], pair: bool) -> Rings:
    nodes, weights, fields = [], [], []
    for right in (False, True):
        for name, uv in pieces.items():
            chart = charts.chart(name)
            index, share = spline(chart.origin, uv.reshape(-1, 2), chart.fields.shape[:2])
            value = np.einsum("ps,psf->pf", share, chart.fields.reshape(-1, 4)[index])
            nodes.append(index.reshape(*uv.shape[:2], 16) + charts.start(name, right))
            weights.append(share.reshape(*uv.shape[:2], 16).astype(np.float32))
            fields.append(value.reshape(*uv.shape[:2], 4).astype(np.float32))
    return Rings(
        levels.astype(np.float32),
        np.stack(nodes, axis=1),
        np.stack(weights, axis=1),
        np.stack(fields, axis=1),
        pair,
        "skirt" in pieces,
    )


@functools.cache
def rings(part: str) -> Rings:
    """Rings of ``torso``, ``leg``, ``arm`` or ``skirt``."""
    charts = load_charts()
    if part == "skirt":
        u = np.linspace(0.0, 2 * SKIRT_QUARTER, 2 * _SAMPLES)
        uv = np.stack([np.stack(np.broadcast_arrays(u, y), axis=1) for y in SKIRT_LEVELS])
        return _rings(charts, SKIRT_LEVELS, {"skirt": uv}, True)
    levels = {"torso": TORSO_LEVELS, "leg": LEG_LEVELS, "arm": ARM_LEVELS}[part]
    low, high = charts.side[: charts.armpit + 1], charts.side[charts.armpit :]
    front, back = [], []
    for level in levels:
        if part == "arm":
            outer = seam_points(high, np.array([seam_row(charts, high, REACH, level)]))[0]
            inner = seam_points(
                charts.over, np.array([seam_row(charts, charts.over, REACH, level)])
            )[0]
        else:
            outer = seam_points(low, np.array([seam_row(charts, low, HEIGHT, level)]))[0]
            inner = (
                np.concatenate(
                    [centre_point(charts, "front", level), centre_point(charts, "back", level)]
                )
                if part == "torso"
                else seam_points(
                    charts.inseam, np.array([seam_row(charts, charts.inseam, HEIGHT, level)])
                )[0]
            )
        field = REACH if part == "arm" else HEIGHT
        front.append(level_curve(charts.front, field, inner[:2], outer[:2], _SAMPLES))
        back.append(level_curve(charts.back, field, inner[2:], outer[2:], _SAMPLES))
    pieces: dict[ChartName, np.ndarray] = {"front": np.stack(front), "back": np.stack(back)}
    return _rings(charts, levels, pieces, part == "torso")
