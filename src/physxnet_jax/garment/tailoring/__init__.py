"""The tailor: garments cut to measure from patterns drawn on the body's helper geometry."""

from ._build import build_charts as build_charts
from ._cut import (
    cut_usual as cut_usual,
    cut_vertices as cut_vertices,
    draw_usual_pattern as draw_usual_pattern,
    measure_usual_arm as measure_usual_arm,
    resolve_measures as resolve_measures,
)
from ._measures import (
    DEFAULT_KINDS as DEFAULT_KINDS,
    KINDS as KINDS,
    MEASURES as MEASURES,
    Kind as Kind,
    Range as Range,
)
from ._pattern import stored_arrays as stored_arrays
from ._tailor import tailor as tailor
