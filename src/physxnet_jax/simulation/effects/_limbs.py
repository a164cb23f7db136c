"""Limbs: which parts of a body or of a garment belong together."""

import numpy as np
from jaxtyping import Bool, Float, Int

from ...body import Body

_LEG = ("{0}UpLeg", "{0}Leg", "{0}Foot", "{0}ToeBase")
_UPPER_ARM = ("{0}Arm",)
_LOWER_ARM = ("{0}ForeArm", "{0}Hand", "{1}Thumb", "{0}FingerBase", "{0}HandFinger1")
TRUNK, LEGS, UPPER_ARMS, LOWER_ARMS = 0, (1, 2), (3, 4), (5, 6)


def limb_labels(
    weights: Float[np.ndarray, "points joints"], body: Body
) -> Int[np.ndarray, " points"]:
    """The limb that carries most of each point's weight: `TRUNK`, `LEGS`, ... left and right."""

    def share(limb: tuple[str, ...]) -> Float[np.ndarray, "points 2"]:
        sides = [[name.format(s, s[0]) for name in limb] for s in ("Left", "Right")]
        return np.stack([weights[:, [body.joint(n) for n in g]].sum(axis=1) for g in sides], axis=1)

    leg, upper, lower = share(_LEG), share(_UPPER_ARM), share(_LOWER_ARM)
    out = np.full(len(weights), TRUNK)
    for side in range(2):
        out[leg[:, side] > 0.5] = LEGS[side]
        arm = upper[:, side] + lower[:, side] > 0.5
        out[arm] = np.where(lower[arm, side] > upper[arm, side], LOWER_ARMS[side], UPPER_ARMS[side])
    return out


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
