"""Affine transforms that materials apply to texture coordinates."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from ..geometry import Polygons

UvTransform = Float[np.ndarray, "2 3"]
"""Maps (u, v, 1) to the coordinates at which an image is sampled."""

_MAX_VALUE = 1e6


def make_uv_transform(
    scale: Any = (1.0, 1.0), offset: Any = (0.0, 0.0), turned: Any = 0.0
) -> UvTransform | None:
    """Builds the transform of a scale, a rotation and an offset.

    Args:
        scale: Scale of u and v, applied first; any value that a file may contain.
        offset: Offset of u and v, applied last.
        turned: Rotation from u to v, applied in between [rad].

    Returns:
        The matrix; None if it is the identity, or if a value is malformed or not
        below 1e6 in magnitude.
    """
    try:
        (su, sv), (ou, ov), angle = map(float, scale), map(float, offset), float(turned)
    except (TypeError, ValueError, OverflowError):
        return None
    if not all(abs(x) < _MAX_VALUE for x in (su, sv, ou, ov, angle)):
        return None
    c, s = np.cos(angle), np.sin(angle)
    move = np.array([[c * su, -s * sv, ou], [s * su, c * sv, ov]])
    return None if np.array_equal(move, np.eye(2, 3)) else move


def moved(uv: Float[np.ndarray, "uvs 2"], move: UvTransform) -> Float[np.ndarray, "uvs 2"]:
    """Applies a transform to texture coordinates."""
    return uv @ move[:, :2].T + move[:, 2]


def transform_uvs(
    uv: Float[np.ndarray, "uvs 2"],
    uv_faces: Int[np.ndarray, "faces 3"],
    polygons: Polygons,
    moves: Mapping[int, UvTransform],
) -> tuple[Float[np.ndarray, "more 2"], Int[np.ndarray, "faces 3"], Polygons]:
    """Applies the transforms of materials to the texture coordinates that they use.

    Args:
        uv: Texture coordinates.
        uv_faces: Their rows at the corners of triangles, cut from the polygons in order.
        polygons: Polygons with rows of texture coordinates.
        moves: Transforms by index of the material, see `make_uv_transform`.

    Returns:
        The same three, with separate rows for each material that has a transform.
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
