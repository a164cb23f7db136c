"""Limb labels of the vertices of bodies and garments."""

import numpy as np
from jaxtyping import Bool, Float, Int

from ...body import CALVES, FOREARMS, HANDS, THIGHS, UPPER_ARMS as _UPPER_ARMS, Body, body_segments

TRUNK, LEGS, UPPER_ARMS, LOWER_ARMS = 0, (1, 2), (3, 4), (5, 6)
_SEGMENT_LABELS = np.zeros(11, np.int64)
_SEGMENT_LABELS[[*THIGHS, *CALVES]] = LEGS * 2
_SEGMENT_LABELS[[*_UPPER_ARMS]] = UPPER_ARMS
_SEGMENT_LABELS[[*FOREARMS, *HANDS]] = LOWER_ARMS * 2


def limb_labels(
    weights: Float[np.ndarray, "points joints"], body: Body
) -> Int[np.ndarray, " points"]:
    """The limb with the largest weight at each point: `TRUNK`, `LEGS`, ..., left and right."""
    return _SEGMENT_LABELS[body_segments(weights, body)]


def adjoining() -> Bool[np.ndarray, "7 7"]:
    """Pairs of labels whose layers may touch; a lower sleeve and the hip, for example, don't."""
    out = np.eye(7, dtype=bool)
    for side in range(2):
        for a, b in (
            (TRUNK, LEGS[side]),
            (TRUNK, UPPER_ARMS[side]),
            (UPPER_ARMS[side], LOWER_ARMS[side]),
        ):
            out[a, b] = out[b, a] = True
    return out
