"""Visible skin: how much of a dressed person shows skin that has come through cloth."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

# Triangles per pass of the rasteriser, which bounds its memory.
_CHUNK = 20000
# Elevations of the cameras, in turn [degrees].
_ELEVATIONS = (-15.0, 15.0)


@dataclasses.dataclass(frozen=True)
class VisibleSkin:
    """Pixels of all cameras.

    Attributes:
        through: Pixels that show skin with cloth close behind it.
        covered: Pixels that show cloth.
    """

    through: int
    covered: int

    @property
    def share(self) -> float:
        """Skin that came through, as a share of the pixels that it or cloth covers."""
        return self.through / max(self.through + self.covered, 1)


def visible_skin(
    skin: Float[np.ndarray, "vertices 3"],
    skin_faces: Int[np.ndarray, "faces 3"],
    cloth: Sequence[tuple[Float[np.ndarray, "_ 3"], Int[np.ndarray, "_ 3"]]],
    *,
    cameras: int = 8,
    pixels: int = 512,
    reach: float = 0.03,
    counted: Bool[np.ndarray, " faces"] | None = None,
) -> VisibleSkin:
    """Looks at a dressed person from all around and counts skin that came through cloth.

    A pixel counts if skin is seen there and the outer side of cloth lies within ``reach`` behind
    it, inside the body. Skin seen through an opening or under a hem has no cloth that near
    behind it, or its inner side; cloth beyond a bare arm lies outside the body. The cameras are
    orthographic, stand around the vertical, look down and up in turn and fit the whole person;
    the result is deterministic.

    Args:
        skin: Skin vertices [m], Y up.
        skin_faces: Triangles of the closed skin, counter-clockwise from outside.
        cloth: Vertices [m] and triangles of each garment, counter-clockwise from outside.
        cameras: Number of cameras.
        pixels: Height and width of the pictures.
        reach: Largest distance from skin to the cloth behind it [m].
        counted: Triangles of the skin that count, say those that the cloth is worn over: a bare
            hand on a skirt is none of them. All by default.

    Returns:
        Counts over all cameras.

    Raises:
        ValueError: Fewer than one camera, or fewer than 16 pixels.
    """
    if cameras < 1 or pixels < 16:
        raise ValueError(f"cameras {cameras} and pixels {pixels} must be at least 1 and 16.")
    counted = np.ones(len(skin_faces), bool) if counted is None else counted
    low, high = skin.min(axis=0), skin.max(axis=0)
    centre = 0.5 * (low + high)
    size = 1.02 * float(np.linalg.norm(high - low))
    through = covered = 0
    for k in range(cameras):
        axes = _axes(2.0 * np.pi * k / cameras, np.radians(_ELEVATIONS[k % len(_ELEVATIONS)]))
        bare, body = _depths([(skin, skin_faces)], axes, centre, size, pixels, [counted])
        outside, inside = _depths(cloth, axes, centre, size, pixels, [None] * len(cloth))
        leaving = _depths([(skin, skin_faces)], axes, centre, size, pixels, [None])[1]
        # Skin in front of all cloth, and the outer side of cloth the first thing behind it.
        first = (outside <= np.minimum(inside, leaving)) & np.isfinite(outside)
        seen = (body < bare) & (body < outside)
        through += int(np.sum(first & seen & (outside < body + reach)))
        front = np.minimum(outside, inside)
        covered += int(np.sum((front <= np.minimum(bare, body)) & np.isfinite(front)))
    return VisibleSkin(through, covered)


def _axes(azimuth: float, elevation: float) -> Float[np.ndarray, "3 3"]:
    """Rows: right, up and into the picture."""
    c, s, e, f = np.cos(azimuth), np.sin(azimuth), np.cos(elevation), np.sin(elevation)
    return np.array([[c, 0.0, -s], [-s * f, e, -c * f], [-s * e, -f, -c * e]])


def _depths(
    meshes: Sequence[tuple[Float[np.ndarray, "_ 3"], Int[np.ndarray, "_ 3"]]],
    axes: Float[np.ndarray, "3 3"],
    centre: Float[np.ndarray, " 3"],
    size: float,
    pixels: int,
    labels: Sequence[Bool[np.ndarray, " _"] | None],
) -> Float[np.ndarray, "2 pixels pixels"]:
    """Depths of the nearest triangles of either label [m]: False first, then True.

    Without labels, triangles that face the camera are False.
    """
    out = np.full((2, pixels * pixels), np.inf)
    for (vertices, faces), label in zip(meshes, labels, strict=True):
        x = (np.asarray(vertices, np.float64) - centre) @ axes.T
        p = (x[:, :2] / size + 0.5) * pixels - 0.5
        tri, z = p[faces], x[faces, 2]
        edges = tri[:, 1:] - tri[:, :1]
        area = edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]
        away_side = area < 0 if label is None else label
        kept = np.flatnonzero(np.abs(area) > 1e-12)
        first = np.maximum(np.ceil(tri.min(axis=1)), 0).astype(np.int64)
        last = np.minimum(np.floor(tri.max(axis=1)), pixels - 1).astype(np.int64)
        kept = kept[(last[kept] >= first[kept]).all(axis=1)]
        for at in range(0, len(kept), _CHUNK):
            f = kept[at : at + _CHUNK]
            span = last[f] - first[f] + 1
            count = span[:, 0] * span[:, 1]
            owner = np.repeat(np.arange(len(f)), count)
            rank = np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count)
            column = first[f][owner, 0] + rank % span[owner, 0]
            row = first[f][owner, 1] + rank // span[owner, 0]
            g = f[owner]
            away = np.column_stack([column, row]) - tri[g, 0]
            u = (away[:, 0] * edges[g, 1, 1] - away[:, 1] * edges[g, 1, 0]) / area[g]
            v = (away[:, 1] * edges[g, 0, 0] - away[:, 0] * edges[g, 0, 1]) / area[g]
            hit = (u >= 0) & (v >= 0) & (u + v <= 1)
            g, u, v = g[hit], u[hit], v[hit]
            depth = (1 - u - v) * z[g, 0] + u * z[g, 1] + v * z[g, 2]
            pixel = row[hit] * pixels + column[hit]
            for side in (False, True):
                mine = away_side[g] == side
                np.minimum.at(out[int(side)], pixel[mine], depth[mine])
    return out.reshape(2, pixels, pixels)
