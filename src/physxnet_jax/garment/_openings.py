"""Openings of a garment, and the limbs that pass through them."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

# Openings of a smaller circumference hold no limb: buttonholes, slits [m].
SMALLEST = 0.15
_Vectors = Float[np.ndarray, "3 #rows #columns"]
# Points of a border that are enough to see what passes through it.
_POINTS = 256


class Opening(NamedTuple):
    """An opening of a garment.

    Attributes:
        loop: Its vertices, in order, shape [n].
        around: Its circumference [m].
        limbs: The limbs that pass through it.
    """

    loop: Int[np.ndarray, " n"]
    around: float
    limbs: tuple[str, ...]


def openings(
    vertices: Float[np.ndarray, "vertices 3"],
    loops: list[Int[np.ndarray, " _"]],
    limbs: dict[str, Float[np.ndarray, "points 3"]],
) -> list[Opening]:
    """Finds the limbs that pass through each border of a mesh.

    A limb passes through a border if the line through it crosses a surface that the border
    bounds an odd number of times.

    Args:
        vertices: Vertices of the garment [m].
        loops: Borders of its mesh, see `boundary_loops`.
        limbs: Lines from the chest through the limbs [m].

    Returns:
        The openings of at least `SMALLEST` around, longest first.
    """
    out = []
    for loop in loops:
        ring = vertices[loop]
        around = float(np.linalg.norm(ring - np.roll(ring, 1, axis=0), axis=1).sum())
        if around < SMALLEST:
            continue
        ring = ring[:: max(1, len(ring) // _POINTS)]
        through = tuple(name for name, line in limbs.items() if _crossings(ring, line) % 2)
        out.append(Opening(loop, around, through))
    return sorted(out, key=lambda o: -o.around)


def _crossings(ring: Float[np.ndarray, "n 3"], line: Float[np.ndarray, "points 3"]) -> int:
    """How often a line crosses the fan of a closed ring about a point near its centre."""
    a, b = ring, np.roll(ring, -1, axis=0)
    # Limbs often pass through the very centre, where all triangles meet.
    apex = ring.mean(axis=0)
    apex = apex + 0.013 * (ring[0] - apex) + 0.007 * (ring[len(ring) // 3] - apex)
    # Rows are segments of the line, columns the fan's triangles.
    e1, e2 = (x.T[:, None] for x in (a - apex, b - apex))
    d, s = (x.T[:, :, None] for x in (line[1:] - line[:-1], line[:-1] - apex))
    p, q = _cross(d, e2), _cross(s, e1)
    det = _dot(e1, p)
    with np.errstate(all="ignore"):
        u, v, t = _dot(p, s) / det, _dot(q, d) / det, _dot(e2, q) / det
        inside = (u >= 0) & (v >= 0) & (u + v < 1)
    return int(((np.abs(det) > 1e-15) & inside & (t >= 0) & (t < 1)).sum())


def _cross(a: _Vectors, b: _Vectors) -> _Vectors:
    return np.stack([a[i] * b[j] - a[j] * b[i] for i, j in ((1, 2), (2, 0), (0, 1))])


def _dot(a: _Vectors, b: _Vectors) -> Float[np.ndarray, "rows columns"]:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
