"""The body's convex outline: where a tape lies around it, and where a skirt hangs from it."""

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import ConvexHull

from ...body import Body
from ._grid import BEYOND, SPACING

# Lowest and highest row of the skirt's grid [m]; its width from the middle to the side.
SKIRT_LEVELS = (-0.795, 0.27)
SKIRT_QUARTER = 0.24
# Below this height a skirt hangs, above it lies on the hip [m].
_HANGS = -0.04
# Nothing is in a skirt's way [m].
_UNLIMITED = 10.0
# Where the thigh is measured [m].
_THIGH = -0.15
_TRUNK = ("Hips", "LHipJoint", "RHipJoint", "LowerBack", "Spine", "Spine1")
_LEGS = ("LeftUpLeg", "RightUpLeg", "LeftLeg", "RightLeg", "LeftFoot", "RightFoot")


def _outline(
    body: Body, rest: np.ndarray, level: float, joints: tuple[str, ...], left: bool = False
) -> tuple[Int[np.ndarray, "corners 2"], Float[np.ndarray, "corners 2"]]:
    """Convex outline of the skin at a height: edges of the skin and shares of their ends.

    Args:
        body: The body.
        rest: Its vertices at rest [m].
        level: The height [m].
        joints: Only skin that mostly follows these counts.
        left: Only the left side counts.
    """
    quads = np.asarray(body.quads)
    weights = np.asarray(body.weights, dtype=np.float64)[:, [body.joint(j) for j in joints]].sum(
        axis=1
    )
    edges = np.unique(
        np.sort(np.concatenate([quads[:, [k, (k + 1) % 4]] for k in range(4)]), axis=1), axis=0
    )
    height = rest[:, 1] - level
    edges = edges[height[edges[:, 0]] * height[edges[:, 1]] < 0]
    edges = edges[weights[edges].mean(axis=1) > 0.5]
    t = height[edges[:, 0]] / (height[edges[:, 0]] - height[edges[:, 1]])
    share = np.column_stack([1 - t, t])
    p = np.einsum("ek,ekc->ec", share, rest[edges])
    if left:
        edges, share, p = edges[p[:, 0] > 0], share[p[:, 0] > 0], p[p[:, 0] > 0]
    corner = ConvexHull(p[:, [0, 2]]).vertices
    return edges[corner], share[corner]


def tapes(body: Body, rest: np.ndarray) -> dict[str, np.ndarray]:
    """Where a tape lies around chest, waist, hip and thigh."""
    trunk = (*_TRUNK, "LeftShoulder", "RightShoulder", "LeftUpLeg", "RightUpLeg")

    def length(level: float, joints: tuple[str, ...], left: bool = False) -> float:
        edges, share = _outline(body, rest, level, joints, left)
        p = np.einsum("ek,ekc->ec", share, rest[edges])[:, [0, 2]]
        return float(np.linalg.norm(p - np.roll(p, -1, axis=0), axis=1).sum())

    levels = {
        "chest": max(np.arange(0.24, 0.355, 0.01), key=lambda y: length(y, trunk)),
        "waist": min(np.arange(0.10, 0.24, 0.01), key=lambda y: length(y, trunk)),
        "hip": max(np.arange(-0.06, 0.06, 0.01), key=lambda y: length(y, trunk)),
        "thigh": _THIGH,
    }
    out: dict[str, np.ndarray] = {}
    for name, level in levels.items():
        edges, share = _outline(
            body, rest, level, _LEGS if name == "thigh" else trunk, name == "thigh"
        )
        out |= {
            f"{name}_refs": edges.astype(np.uint16),
            f"{name}_weights": share.astype(np.float32),
        }
        out[f"{name}_level"] = np.asarray(level)
    return out


def skirt_grid(body: Body, rest: np.ndarray) -> dict[str, np.ndarray]:
    """A grid over the left half of the convex outline of trunk and legs.

    Columns run from the middle of the front over the side to the middle of the back, rows up.
    """
    levels = SPACING * np.arange(
        round(SKIRT_LEVELS[0] / SPACING), round(SKIRT_LEVELS[1] / SPACING) + 1
    )
    quarter = round(SKIRT_QUARTER / SPACING)
    columns = np.arange(-BEYOND, 2 * quarter + BEYOND + 1)
    refs = np.zeros((len(levels), len(columns), 4), np.int64)
    weights = np.zeros((len(levels), len(columns), 4))
    height_refs = np.zeros((len(levels), 8, 2), np.int64)
    height_weights = np.zeros((len(levels), 8, 2))
    edges, share = np.zeros((0, 2), np.int64), np.zeros((0, 2))
    for row in reversed(range(len(levels))):
        level = levels[row]
        own, own_share = _outline(body, rest, level, (*_TRUNK, *_LEGS))
        some = np.linspace(0, len(own), 8, endpoint=False).astype(int)
        height_refs[row], height_weights[row] = own[some], own_share[some]
        if level > _HANGS:
            edges, share = own, own_share
        else:
            # Cloth hangs straight down from the widest place above.
            edges, share = np.concatenate([edges, own]), np.concatenate([share, own_share])
        p = np.einsum("ek,ekc->ec", share, rest[edges])[:, [0, 2]]
        corner = ConvexHull(p).vertices
        edges, share, p = edges[corner], share[corner], p[corner]
        # From the middle of the front over the left side: find where the outline crosses x = 0.
        n = len(p)
        after = (np.arange(n) + 1) % n
        length = np.linalg.norm(p[after] - p, axis=1)
        start = np.concatenate([[0.0], np.cumsum(length)])
        cross = [k for k in range(n) if p[k, 0] * p[after[k], 0] <= 0 and p[k, 0] != p[after[k], 0]]
        place = {k: start[k] + length[k] * p[k, 0] / (p[k, 0] - p[after[k], 0]) for k in cross}
        depth = {k: float(p[k, 1] + p[after[k], 1]) for k in cross}
        middle, behind = (
            place[max(depth, key=depth.__getitem__)],
            place[min(depth, key=depth.__getitem__)],
        )
        side = start[int(np.argmax(p[:, 0]))]
        total = start[-1]
        forward = 1.0 if (side - middle) % total < (behind - middle) % total else -1.0
        first, both = (forward * (side - middle)) % total, (forward * (behind - middle)) % total
        tau = columns / quarter
        # Beyond the middle the outline is mirrored in speed as in shape.
        folded = np.where(tau < 0, -tau, np.where(tau > 2, 4 - tau, tau))
        arc = np.where(folded < 1, folded * first, first + (folded - 1) * (both - first))
        arc = np.where(tau < 0, -arc, np.where(tau > 2, 2 * both - arc, arc))
        spot = (middle + forward * arc) % total
        k = np.clip(np.searchsorted(start, spot, side="right") - 1, 0, n - 1)
        t = (spot - start[k]) / length[k]
        refs[row] = np.concatenate([edges[k], edges[after[k]]], axis=1)
        weights[row] = np.concatenate(
            [(1 - t)[:, None] * share[k], t[:, None] * share[after[k]]], axis=1
        )
    fields = np.zeros((len(levels), len(columns), 4), np.float32)
    fields[..., 0] = levels[:, None]
    fields[..., 3] = _UNLIMITED
    return {
        "skirt_origin": SPACING * np.array([-BEYOND, round(SKIRT_LEVELS[0] / SPACING)]),
        "skirt_refs": refs.astype(np.uint16),
        "skirt_weights": weights.astype(np.float32),
        "skirt_fields": fields,
        "skirt_height_refs": height_refs.astype(np.uint16),
        "skirt_height_weights": height_weights.astype(np.float32),
        "skirt_inside": np.ones(fields.shape[:2], bool),
    }
