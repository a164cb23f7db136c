"""The dress body: legs joined by an ellipsoid hull, same topology and uv."""

import numpy as np
from jaxtyping import Float

from ..body import NUM_BODY_VERTICES, Body

# The inner half of a leg lies this much deeper than the outer half, so that a ray from
# outside always meets the outer one first.
_INNER = 0.12
_BLEND = 0.08


def dress_body(body: Body, rest: Float[np.ndarray, "all 3"]) -> Float[np.ndarray, "vertices 3"]:
    """Body vertices at rest with the legs expanded to one elliptic column.

    At each height the outer half of each leg becomes half of the ellipse that encloses
    both legs, so that normals hit a skirt all around. The inner half folds beneath it.

    Args:
        body: The body.
        rest: Its rest vertices [m].

    Returns:
        Positions [m] of the 13,380 body vertices.

    References:
        PhysXNet, section 4.2: the mesh M_Bd for dresses.
    """
    v = np.asarray(rest[:NUM_BODY_VERTICES], dtype=np.float64).copy()
    weights = np.asarray(body.weights)[:NUM_BODY_VERTICES]
    sides = {
        s: weights[:, [body.joint(f"{s}{n}") for n in ("UpLeg", "Leg", "Foot", "ToeBase")]].sum(
            axis=1
        )
        for s in ("Left", "Right")
    }
    leg = np.maximum(sides["Left"], sides["Right"])
    heads = np.asarray(rest)[np.asarray(body.joint_rows)].mean(axis=2)[:, 0]
    crotch = float(heads[body.joint("LeftUpLeg"), 1]) - 0.07
    ankle = float(heads[body.joint("LeftFoot"), 1])
    member = (leg > 0.5) & (v[:, 1] < crotch + _BLEND) & (v[:, 1] > ankle)
    levels = np.linspace(ankle, crotch + _BLEND, 24)
    half_x, half_z, mid_z = [], [], []
    for y in levels:
        ring = v[member & (np.abs(v[:, 1] - y) < 0.04)]
        low, high = ring.min(axis=0), ring.max(axis=0)
        half_x.append(np.abs(ring[:, 0]).max())
        half_z.append(0.5 * (high[2] - low[2]))
        mid_z.append(0.5 * (high[2] + low[2]))
    a, b, c = (np.interp(v[:, 1], levels, h) for h in (half_x, half_z, mid_z))
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        rows = np.flatnonzero(member & (sides[side] > 0.5))
        hip, knee, foot = (heads[body.joint(f"{side}{n}")] for n in ("UpLeg", "Leg", "Foot"))
        x, y, z = v[rows].T
        axis = [
            np.interp(y, [foot[1], knee[1], hip[1]], [foot[k], knee[k], hip[k]]) for k in (0, 2)
        ]
        # Angle around the leg: 0 outwards, 90 degrees in front. The outer half of the ring
        # becomes half the ellipse; the inner half folds back beneath it.
        angle = np.arctan2(z - axis[1], sign * (x - axis[0]))
        inner = np.clip((np.abs(angle) - np.pi / 2) / (np.pi / 2), 0.0, 1.0)
        folded = np.where(inner > 0, np.sign(angle) * np.pi - angle, angle)
        depth = 1.0 - _INNER * np.clip(4 * inner, 0.0, 1.0)
        hull = np.column_stack(
            [
                sign * a[rows] * depth * np.cos(folded),
                y,
                c[rows] + b[rows] * depth * np.sin(folded),
            ]
        )
        fade = np.clip((crotch + _BLEND - y) / _BLEND, 0.0, 1.0)[:, None]
        v[rows] += fade * (hull - v[rows])
    return v
