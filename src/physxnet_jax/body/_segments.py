"""Segments of the body: parts that fold onto each other but hardly onto themselves."""

import numpy as np
from jaxtyping import Float, Int

from ._body import Body

TRUNK = 0
THIGHS, CALVES, UPPER_ARMS, FOREARMS, HANDS = (1, 2), (3, 4), (5, 6), (7, 8), (9, 10)
_JOINTS = (
    ("{0}UpLeg",),
    ("{0}Leg", "{0}Foot", "{0}ToeBase"),
    ("{0}Arm",),
    ("{0}ForeArm",),
    ("{0}Hand", "{1}Thumb", "{0}FingerBase", "{0}HandFinger1"),
)


def body_segments(
    weights: Float[np.ndarray, "points joints"], body: Body
) -> Int[np.ndarray, " points"]:
    """The segment that carries most of each point's skinning weight.

    Args:
        weights: Skinning weights of skin or cloth.
        body: The body whose joints the weights refer to.

    Returns:
        `TRUNK`, or one of `THIGHS`, `CALVES` (with the foot), `UPPER_ARMS`, `FOREARMS`
        and `HANDS`, left and right.
    """
    shares = [
        weights[:, [body.joint(name.format(side, side[0])) for name in names]].sum(axis=1)
        for names in _JOINTS
        for side in ("Left", "Right")
    ]
    return np.stack([1.0 - sum(shares), *shares], axis=1).argmax(axis=1)
