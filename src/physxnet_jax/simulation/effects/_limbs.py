"""Limbs: which parts of a body or of a garment belong together."""

import numpy as np
from jaxtyping import Bool, Float, Int

from ... import body as _body
from ...body import Body, body_segments

TRUNK, LEGS, UPPER_ARMS, LOWER_ARMS = 0, (1, 2), (3, 4), (5, 6)
_OF_SEGMENT = np.zeros(11, np.int64)
_OF_SEGMENT[[*_body.THIGHS, *_body.CALVES]] = LEGS * 2
_OF_SEGMENT[[*_body.UPPER_ARMS]] = UPPER_ARMS
_OF_SEGMENT[[*_body.FOREARMS, *_body.HANDS]] = LOWER_ARMS * 2


def limb_labels(
    weights: Float[np.ndarray, "points joints"], body: Body
) -> Int[np.ndarray, " points"]:
    """The limb that carries most of each point's weight: `TRUNK`, `LEGS`, ... left and right."""
    return _OF_SEGMENT[body_segments(weights, body)]


def adjoining() -> Bool[np.ndarray, "7 7"]:
    """Which labels meet as layers of one place: a sleeve by the hip doesn't."""
    out = np.eye(7, dtype=bool)
    for side in range(2):
        for a, b in (
            (TRUNK, LEGS[side]),
            (TRUNK, UPPER_ARMS[side]),
            (UPPER_ARMS[side], LOWER_ARMS[side]),
        ):
            out[a, b] = out[b, a] = True
    return out
