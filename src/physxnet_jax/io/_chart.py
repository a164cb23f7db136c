"""Texture coordinates that a material scales, turns and moves before it looks at its image."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from ..geometry import Polygons

Move = Float[np.ndarray, "2 3"]
"""Takes (u, v, 1) to the coordinates that an image is looked up by."""

_MOST = 1e6


def make_move(scale: Any = (1.0, 1.0), offset: Any = (0.0, 0.0), turned: Any = 0.0) -> Move | None:
    """The move of a scale, a turn and an offset.

    Args:
        scale: Of u and v, first of all; whatever a file says.
        offset: Of u and v, at last.
        turned: Between them, from u to v [rad].

    Returns:
        The matrix; None if it changes nothing, or isn't two numbers each, none beyond
        anything that an image is repeated.
    """
    try:
        (su, sv), (ou, ov), angle = map(float, scale), map(float, offset), float(turned)
    except (TypeError, ValueError, OverflowError):
        return None
    if not all(abs(x) < _MOST for x in (su, sv, ou, ov, angle)):
        return None
    c, s = np.cos(angle), np.sin(angle)
    move = np.array([[c * su, -s * sv, ou], [s * su, c * sv, ov]])
    return None if np.array_equal(move, np.eye(2, 3)) else move


def moved(uv: Float[np.ndarray, "uvs 2"], move: Move) -> Float[np.ndarray, "uvs 2"]:
    """Texture coordinates after a move."""
    return uv @ move[:, :2].T + move[:, 2]


def moved_charts(
    uv: Float[np.ndarray, "uvs 2"],
    uv_faces: Int[np.ndarray, "faces 3"],
    polygons: Polygons,
    moves: Mapping[int, Move],
) -> tuple[Float[np.ndarray, "more 2"], Int[np.ndarray, "faces 3"], Polygons]:
    """Coordinates as images are looked up by, so that no material needs to move them.

    Args:
        uv: Texture coordinates.
        uv_faces: Their rows at the corners of triangles, cut from the polygons in order.
        polygons: Polygons with rows of texture coordinates.
        moves: Of materials by number, see `make_move`.

    Returns:
        The same, with rows of its own for each material that moves them.
    """
    corners = polygons.uv_corners
    if corners is None or not moves:
        return uv, uv_faces, polygons
    corners, uv_faces = corners.copy(), uv_faces.copy()
    of_corner = np.repeat(polygons.material, polygons.counts)
    of_face = polygons.material[polygons.of_triangle]
    rows, count = [uv], len(uv)
    for material, move in moves.items():
        here = of_corner == material
        used = np.unique(corners[here])
        number = np.zeros(len(uv), corners.dtype)
        number[used] = count + np.arange(len(used))
        corners[here] = number[corners[here]]
        there = of_face == material
        uv_faces[there] = number[uv_faces[there]]
        rows.append(moved(uv[used], move))
        count += len(used)
    return np.concatenate(rows), uv_faces, dataclasses.replace(polygons, uv_corners=corners)
