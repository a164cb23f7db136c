"""Triangulates a polygon evenly, its corners and sides kept."""

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import Delaunay

from ...errors import MeshError

_STEPS = 120
_TIME_STEP = 0.2
# Rest lengths are a little longer than edges, so that vertices press against the border.
_PRESSURE = 1.2
# Attempts to free sides that other vertices hide.
_REPAIRS = 8
# Lattice points nearer to the border than this are left out, in spacings.
_BORDER = 0.5


def mesh_polygon(
    border: Float[np.ndarray, "border 2"], spacing: float
) -> tuple[Float[np.ndarray, "vertices 2"], Int[np.ndarray, "faces 3"]]:
    """Fills a polygon with nearly equilateral triangles.

    Args:
        border: Corners, anticlockwise, about one spacing apart.
        spacing: Length of edges.

    Returns:
        Vertices, those of the border first and unmoved, and anticlockwise triangles. The same
        input gives the same mesh: vertices start on a lattice, not at random.

    Raises:
        MeshError: A side of the polygon isn't an edge of the mesh; it is too long for the spacing
            or passes too close to another side.

    References:
        Persson and Strang, A simple mesh generator in MATLAB (2004).
    """
    fixed = len(border)
    p = np.concatenate([border, _lattice(border, spacing)])
    for step in range(_STEPS):
        if step % 4 == 0:
            faces = _inside_faces(p, border)
            edges = np.unique(
                np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])),
                axis=0,
            )
        bar = p[edges[:, 0]] - p[edges[:, 1]]
        length = np.linalg.norm(bar, axis=1)
        wanted = _PRESSURE * np.sqrt((length**2).mean())
        force = np.maximum(wanted - length, 0.0)[:, None] * bar / length[:, None]
        total = np.zeros_like(p)
        np.add.at(total, edges[:, 0], force)
        np.add.at(total, edges[:, 1], -force)
        total[:fixed] = 0.0
        moved = p + _TIME_STEP * total
        stay = ~points_in_polygon(moved, border)
        stay[:fixed] = True
        p = np.where(stay[:, None], p, moved)
    for _ in range(_REPAIRS):
        faces = _inside_faces(p, border)
        lost = _lost_sides(faces, fixed)
        if not len(lost):
            return p, faces
        if len(p) == fixed:
            break
        # A vertex inside the circle over a side comes between its ends.
        middle = 0.5 * (border[lost] + border[(lost + 1) % fixed])
        radius = np.linalg.norm(border[lost] - middle, axis=1)
        distance = np.linalg.norm(p[fixed:, None] - middle, axis=2)
        near = (distance < 1.01 * radius).any(axis=1)
        near[np.argmin(distance, axis=0)] = True
        p = np.concatenate([border, p[fixed:][~near]])
    raise MeshError(
        f"{len(lost)} of {fixed} sides of a panel aren't edges of its mesh, the first near"
        f" {border[lost[0]].round(3)}: there it is too narrow for edges of {spacing:.4f} m, or"
        " crosses itself."
    )


def _lost_sides(faces: Int[np.ndarray, "faces 3"], fixed: int) -> Int[np.ndarray, " lost"]:
    """Sides of the border that aren't edges of a face."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    have = {tuple(e) for e in edges.tolist()}
    return np.array([k for k in range(fixed) if (k, (k + 1) % fixed) not in have], dtype=np.int64)


def _lattice(border: Float[np.ndarray, "border 2"], spacing: float) -> Float[np.ndarray, "n 2"]:
    """Points of a triangular lattice inside a polygon, symmetric about its first coordinate's 0."""
    low, high = border.min(axis=0) - spacing, border.max(axis=0) + spacing
    row = spacing * np.sqrt(0.75)
    rows = np.arange(np.floor(low[1] / row), np.ceil(high[1] / row) + 1)
    columns = np.arange(np.floor(low[0] / spacing), np.ceil(high[0] / spacing) + 1)
    x, y = np.meshgrid(columns * spacing, rows * row)
    x = x + 0.5 * spacing * (rows % 2)[:, None]
    p = np.column_stack([x.ravel(), y.ravel()])
    p = p[points_in_polygon(p, border)]
    return p[distance_to_polygon(p, border) > _BORDER * spacing]


def _inside_faces(
    p: Float[np.ndarray, "vertices 2"], border: Float[np.ndarray, "border 2"]
) -> Int[np.ndarray, "faces 3"]:
    faces = Delaunay(p).simplices.astype(np.int64)
    a, b, c = (p[faces[:, k]] for k in range(3))
    area = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    faces = np.where((area < 0)[:, None], faces[:, [0, 2, 1]], faces)
    return faces[points_in_polygon((a + b + c) / 3, border) & (np.abs(area) > 1e-12)]


def points_in_polygon(
    p: Float[np.ndarray, "points 2"], border: Float[np.ndarray, "border 2"]
) -> Bool[np.ndarray, " points"]:
    """Points inside a polygon, by counting crossings."""
    a, b = border, np.roll(border, -1, axis=0)
    inside = np.zeros(len(p), dtype=bool)
    for (x0, y0), (x1, y1) in zip(a, b):
        if y0 == y1:
            continue
        between = (p[:, 1] >= min(y0, y1)) & (p[:, 1] < max(y0, y1))
        inside ^= between & (p[:, 0] < x0 + (p[:, 1] - y0) * (x1 - x0) / (y1 - y0))
    return inside


def distance_to_polygon(
    p: Float[np.ndarray, "points 2"], border: Float[np.ndarray, "border 2"]
) -> Float[np.ndarray, " points"]:
    """Distance of points to the nearest side of a polygon."""
    best = np.full(len(p), np.inf)
    for a, b in zip(border, np.roll(border, -1, axis=0)):
        side = b - a
        t = np.clip((p - a) @ side / max(float(side @ side), 1e-30), 0.0, 1.0)
        best = np.minimum(best, np.linalg.norm(p - a - t[:, None] * side, axis=1))
    return best
