"""Aligns a garment mesh with a template: rotation, scale and translation."""

import numpy as np

from ..geometry import TriMesh
from ._fit import clearance
from ._garment import Garment
from ._locate import UNITS, skin_misfit

# Tolerance on the size error of candidates, and improvement that a rotation must bring [m].
_SIZE_TOLERANCE, _MIN_GAIN = 0.1, 0.001
# Rotations that map a file's up axis to Y.
_UP_ROTATIONS = {
    "Y": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "Z": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "X": ((0, -1, 0), (1, 0, 0), (0, 0, 1)),
}
# Garments whose log height ratio to the template is below this keep their size.
_MAX_LOG_RATIO = 0.2
# Shifts to try: vertical, and front to back [m].
_Y_SHIFTS, _Z_SHIFTS = np.linspace(-0.08, 0.08, 9), np.linspace(-0.03, 0.03, 7)


def align_to_template(
    vertices: np.ndarray, wanted: Garment, skin: TriMesh
) -> tuple[np.ndarray, str, float]:
    """Rotates, scales and moves a mesh onto a template's bounding box.

    The up axis and the facing direction minimise the mean distance from the skin plus the
    size error, so that trousers aren't taken for a top.

    Returns:
        The placed vertices [m], a description of the placement, and its misfit [m].
    """
    x = np.asarray(wanted.mesh.vertices, np.float64)
    low, high = x.min(axis=0), x.max(axis=0)
    candidates = []
    for up, rotation in _UP_ROTATIONS.items():
        upright = vertices @ np.array(rotation, np.float64).T
        for quarter in range(4):
            size = np.ptp(upright, axis=0)
            # A mesh that is flat in this orientation has no height to scale.
            if size[1] > 1e-6 * size.max() > 0:
                scale = _snap_to_unit(float((high - low)[1] / size[1]))
                size_error = float(np.mean(np.abs(scale * size - (high - low))))
                # Aligned at the top, where a garment is held: neck or waist.
                held = upright.min(axis=0) + size * [0.5, 1.0, 0.5]
                placed = (upright - held) * scale + np.where(
                    [False, True, False], high, 0.5 * (low + high)
                )
                candidates.append((size_error, up, quarter, scale, placed))
            upright = upright[:, [2, 1, 0]] * [1.0, 1.0, -1.0]
    size_limit = min((t[0] for t in candidates), default=0.0) + _SIZE_TOLERANCE
    best = (vertices, "it has no height.", np.inf)
    for size_error, up, quarter, scale, placed in candidates:
        # Candidates of a clearly different size aren't compared with the skin.
        if size_error > size_limit:
            continue
        distance, _ = clearance(skin, placed.astype(np.float32))
        error = float(np.mean(np.abs(distance))) + size_error
        # Near ties are resolved in favour of no rotation.
        if error + (_MIN_GAIN if quarter else 0.0) < best[2]:
            about = f", turned by {90 * quarter} degrees about it" if quarter else ""
            description = (
                f"scaled by {scale:.4g}, {up} up{about}, moved to where a {wanted.template} is."
            )
            best = (placed, description, error)
    placed, description, error = best
    return _best_shift(placed, skin), description, error


def _best_shift(placed: np.ndarray, skin: TriMesh) -> np.ndarray:
    """Shifts a mesh by a few centimetres, vertically and front to back, to the best fit."""
    misfit = skin_misfit(skin)
    shifts = [np.array([0.0, y, z]) for y in _Y_SHIFTS for z in _Z_SHIFTS]
    return placed + min(shifts, key=lambda d: misfit(placed + d, 0.0) + 0.1 * np.abs(d).sum())


def _snap_to_unit(scale: float) -> float:
    """The scale of the nearest unit if the two are close, else the given scale."""
    near = min(UNITS.values(), key=lambda s: abs(np.log(scale / s)))
    return near if abs(np.log(scale / near)) < _MAX_LOG_RATIO else scale
