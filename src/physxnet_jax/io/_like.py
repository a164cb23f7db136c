"""A garment put where a template is: turned, scaled, moved."""

import numpy as np

from ..garment import Garment, clearance
from ..geometry import TriMesh
from ._place import UNITS, skin_misfit

# Sizes within which meshes are alike, and what turning one has to gain [m].
_UNLIKE, _TURNED = 0.1, 0.001
# Rotations that make an axis of a file Y.
_UPRIGHT = {
    "Y": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "Z": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "X": ((0, -1, 0), (1, 0, 0), (0, 0, 1)),
}
# Garments this much longer or shorter than a template (a logarithm) keep their size.
_ITS_SIZE = 0.2
# How far such a one is tried up and down, to the front and back [m].
_RISES, _ADVANCES = np.linspace(-0.08, 0.08, 9), np.linspace(-0.03, 0.03, 7)


def place_like(
    vertices: np.ndarray, wanted: Garment, skin: TriMesh
) -> tuple[np.ndarray, str, float]:
    """The mesh turned, scaled and moved onto a template's box, how, and how far off it is [m].

    Whichever axis is up and wherever the front is are found by the mean distance from the
    skin; sizes count as well, so that trousers aren't taken for a top.
    """
    x = np.asarray(wanted.mesh.vertices, np.float64)
    low, high = x.min(axis=0), x.max(axis=0)
    tried = []
    for up, turns in _UPRIGHT.items():
        upright = vertices @ np.array(turns, np.float64).T
        for quarter in range(4):
            size = np.ptp(upright, axis=0)
            # What is flat in this position has no height to be scaled to.
            if size[1] > 1e-6 * size.max() > 0:
                scale = _in_its_unit(float((high - low)[1] / size[1]))
                unlike = float(np.mean(np.abs(scale * size - (high - low))))
                # Hung from where it is held: neck or waist.
                held = upright.min(axis=0) + size * [0.5, 1.0, 0.5]
                placed = (upright - held) * scale + np.where(
                    [False, True, False], high, 0.5 * (low + high)
                )
                tried.append((unlike, up, quarter, scale, placed))
            upright = upright[:, [2, 1, 0]] * [1.0, 1.0, -1.0]
    alike = min((t[0] for t in tried), default=0.0) + _UNLIKE
    best = (vertices, "it has no height.", np.inf)
    for unlike, up, quarter, scale, placed in tried:
        # What has another shape altogether needn't be compared with the skin.
        if unlike > alike:
            continue
        distance, _ = clearance(skin, placed.astype(np.float32))
        off = float(np.mean(np.abs(distance))) + unlike
        # A mesh that could as well stay as it is isn't turned.
        if off + (_TURNED if quarter else 0.0) < best[2]:
            about = f", turned by {90 * quarter} degrees about it" if quarter else ""
            told = f"scaled by {scale:.4g}, {up} up{about}, moved to where a {wanted.template} is."
            best = (placed, told, off)
    placed, told, off = best
    return _settled(placed, skin), told, off


def _settled(placed: np.ndarray, skin: TriMesh) -> np.ndarray:
    """Moved up or down, to the front or back by a few centimetres, to where it fits best."""
    misfit = skin_misfit(skin)
    ways = [np.array([0.0, y, z]) for y in _RISES for z in _ADVANCES]
    return placed + min(ways, key=lambda d: misfit(placed + d, 0.0) + 0.1 * np.abs(d).sum())


def _in_its_unit(scale: float) -> float:
    """A unit's own scale, if a garment is of about the wanted size in it."""
    near = min(UNITS.values(), key=lambda s: abs(np.log(scale / s)))
    return near if abs(np.log(scale / near)) < _ITS_SIZE else scale
