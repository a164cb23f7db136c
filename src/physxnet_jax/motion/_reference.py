"""Reference pose of a skeleton, in which the directions of its limbs are known."""

import dataclasses
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from ..body import smallest_rotation
from ..errors import MotionError
from ._skeletons import LIMBS
from ._source import SourceClip

_BOTH = ("Left", "Right")
# Bones shorter or longer than this have no usable direction.
SHORTEST, LONGEST = 1e-9, 1e9
# A rest pose is a standing pose if its legs and trunk lean less than 45 degrees.
_STANDING = float(np.cos(np.radians(45.0)))
# A mean trunk direction with a component above this points that way throughout the clip.
ALWAYS = 0.8
# Turns Z up to Y up.
Y_UP = Rotation.from_euler("X", -90, degrees=True).as_matrix()
# A T-pose that isn't part of a motion is left within this time [s].
_SOON = 0.25
# DAZ figures hold their forearms 17 degrees forward in their T-pose.
_T_POSE = float(np.cos(np.radians(25.0)))


def upright(source: SourceClip, index: Mapping[str, int]) -> SourceClip:
    """Turns the clip to Y up if its skeleton stands along Z at rest.

    Only the rest pose is turned if the motion stands along Y already. If the user states the
    motion's up axis, this counts.
    """
    turned = source.turned(Y_UP)
    lies = stands(source, index, 2) and not stands(source, index, 1)
    if source.up is not None:
        out = turned if source.up == "z" else source
        return dataclasses.replace(out, rest=(turned if lies else source).rest)
    if lies:
        if mean_trunk(source, index)[1] > ALWAYS:
            return dataclasses.replace(source, rest=turned.rest)
        return turned
    return source


def mean_trunk(source: SourceClip, index: Mapping[str, int]) -> Float[np.ndarray, "3"]:
    """Mean unit direction from hips to shoulders; its length is 1 if it is constant."""
    p = source.positions()
    hips, arms = (p[:, index[f"Left{n}"]] + p[:, index[f"Right{n}"]] for n in ("UpLeg", "Arm"))
    trunk = arms - hips
    return np.mean(trunk / np.maximum(np.linalg.norm(trunk, axis=1, keepdims=True), 1e-9), axis=0)


def stands(source: SourceClip, index: Mapping[str, int], axis: int) -> bool:
    """Whether both legs point down this axis at rest, and the trunk points up."""
    positions = _pose_positions(source, source.rest_rotations())
    legs = [positions[index[f"{s}Foot"]] - positions[index[f"{s}UpLeg"]] for s in _BOTH]
    trunk = _trunk(positions, index)
    down = min(-leg[axis] / max(np.linalg.norm(leg), 1e-9) for leg in legs)
    return bool(down > _STANDING and trunk[axis] > _STANDING * np.linalg.norm(trunk))


class Reference(NamedTuple):
    """The reference pose of a clip.

    Attributes:
        rotations: World rotations of the skeleton's joints, shape [bones, 3, 3].
        start: First frame of motion: 1 if frame 0 is a T-pose.
        stance: Orientation of the person's hips in it (columns left, up, forward).
        twist: Turn of the line through the shoulders against that through the hips, about
            the trunk [rad].
        kind: Description.
    """

    rotations: Float[np.ndarray, "bones 3 3"]
    start: int
    stance: Float[np.ndarray, "3 3"]
    twist: float
    kind: str


def reference_pose(source: SourceClip, index: Mapping[str, int], turned: bool = False) -> Reference:
    """Finds the reference pose of a clip.

    Args:
        source: The clip.
        index: Body joint to index of the clip's joint.
        turned: Whether the skeleton was turned upright, for the description.

    Note:
        Frame 0 may be a T-pose that isn't part of the motion: always in formats that can't
        store a rest pose, in others if the arms leave it within a quarter of a second.
    """
    first = source.rotations[0]
    limbs = {k: v for k, v in index.items() if k in LIMBS and LIMBS[k] in index}
    rest = source.rest_rotations()
    standing = stands(source, index, 1)
    stance = _heading(_pose_positions(source, rest), index) if standing else np.eye(3)
    upright = np.abs(first[index["Hips"]] - rest[index["Hips"]]).max() < 0.1
    start = 0
    if upright and len(source.root) > 1 and _is_t_pose(source, index, limbs, stance, 0):
        if source.rest is None:
            kind = "the T-pose in its first frame, which is dropped"
            return Reference(first, 1, stance, 0.0, kind)
        soon = min(int(np.ceil(_SOON * source.fps)), len(source.root) - 1)
        start = int(not _is_t_pose(source, index, limbs, stance, soon))
    dropped = "; the T-pose in its first frame is dropped" if start else ""
    if not standing:
        frame = _straightest(source, index)
        pose = source.rotations[frame]
        twist = _twist(source.positions()[frame], index)
        kind = "the frame in which the person stands straightest" + dropped
        return Reference(pose, start, _stance(source, frame, index), twist, kind)
    # CMU's skeletons stand astride at rest: turn each leg as a whole to a vertical thigh.
    pose = rest.copy()
    pointing = limb_directions(source, index, pose)
    for side in _BOTH:
        turn = smallest_rotation(pointing[f"{side}UpLeg"], np.array([0.0, -1.0, 0.0]))
        member = {index[f"{side}UpLeg"]}
        for j, parent in enumerate(source.parents):
            if parent in member:
                member.add(j)
        for j in member:
            pose[j] = turn.as_matrix() @ pose[j]
    kind = "its rest pose" + (", turned upright" if turned else "") + dropped
    return Reference(pose, start, stance, 0.0, kind)


def _is_t_pose(
    source: SourceClip,
    index: Mapping[str, int],
    limbs: Mapping[str, int],
    stance: Float[np.ndarray, "3 3"],
    frame: int,
) -> bool:
    """Whether arms point sideways and legs down in a frame."""
    pointing = limb_directions(source, index, source.rotations[frame])
    sideways = [
        (1.0 if k.startswith("Left") else -1.0) * float(pointing[k] @ stance[:, 0])
        for k in limbs
        if "Arm" in k
    ]
    down = [-pointing[k][1] for k in limbs if "Leg" in k]
    return bool(min(sideways + down) > _T_POSE)


def _twist(positions: Float[np.ndarray, "bones 3"], index: Mapping[str, int]) -> float:
    """Turn of the shoulders' line against the hips', about the trunk [rad]."""
    hips, arms = (
        positions[index[f"Left{n}"]] - positions[index[f"Right{n}"]] for n in ("UpLeg", "Arm")
    )
    up = _trunk(positions, index)
    up = up / max(np.linalg.norm(up), SHORTEST)
    return float(np.arctan2(up @ np.cross(hips, arms), hips @ arms - (hips @ up) * (arms @ up)))


def _heading(
    positions: Float[np.ndarray, "bones 3"], index: Mapping[str, int]
) -> Float[np.ndarray, "3 3"]:
    """Left, up and forward of a standing skeleton; the world's axes if within 45 degrees of them.

    The hips of real skeletons are only roughly parallel to the intended axis.
    """
    left = positions[index["LeftUpLeg"]] - positions[index["RightUpLeg"]]
    left = left * [1.0, 0.0, 1.0]
    size = np.linalg.norm(left)
    if not SHORTEST < size < LONGEST or left[0] > _STANDING * size:
        return np.eye(3)
    left, up = left / size, np.array([0.0, 1.0, 0.0])
    return np.stack([left, up, np.cross(left, up)], axis=1)


def _straightest(source: SourceClip, index: Mapping[str, int]) -> int:
    """The frame in which the person stands most upright on straight legs.

    The limbs' twist is assumed to be that of the rest pose, which holds for standing.
    """
    p = source.positions()
    unit = lambda d: d / np.maximum(np.linalg.norm(d, axis=-1, keepdims=True), 1e-9)  # noqa: E731
    hips, arms = (
        0.5 * (p[:, index[f"Left{n}"]] + p[:, index[f"Right{n}"]]) for n in ("UpLeg", "Arm")
    )
    upright = unit(arms - hips)[:, 1]
    across = unit(p[:, index["LeftUpLeg"]] - p[:, index["RightUpLeg"]])
    for side in _BOTH:
        for a, b in (("UpLeg", "Leg"), ("Leg", "Foot")):
            upright = upright - unit(p[:, index[side + b]] - p[:, index[side + a]])[:, 1]
        upper = unit(p[:, index[f"{side}ForeArm"]] - p[:, index[f"{side}Arm"]])
        lower = unit(p[:, index[f"{side}Hand"]] - p[:, index[f"{side}ForeArm"]])
        forward = np.cross(across, np.array([0.0, 1.0, 0.0]))
        upright = upright + (upper * lower).sum(axis=1) - np.abs((upper * forward).sum(axis=1))
    return int(np.argmax(upright))


def _stance(source: SourceClip, frame: int, index: Mapping[str, int]) -> Float[np.ndarray, "3 3"]:
    """Left, up and forward of the trunk in a frame, as columns."""
    positions = source.positions()[frame]
    left = positions[index["LeftUpLeg"]] - positions[index["RightUpLeg"]]
    up = _trunk(positions, index)
    size, high = np.linalg.norm(left), np.linalg.norm(up)
    if not (SHORTEST < size < LONGEST and SHORTEST < high < LONGEST):
        raise _no_trunk(source)
    left, up = left / size, up / high
    left = left - (left @ up) * up
    if np.linalg.norm(left) < 1e-6:
        raise _no_trunk(source)
    left = left / np.linalg.norm(left)
    return np.stack([left, up, np.cross(left, up)], axis=1)


def _no_trunk(source: SourceClip) -> MotionError:
    return MotionError.at(
        source.path,
        None,
        "hips and shoulders lie on one point or one line, so the up direction is undefined",
        "Map other joints",
    )


def _trunk(
    positions: Float[np.ndarray, "bones 3"], index: Mapping[str, int]
) -> Float[np.ndarray, "3"]:
    hips, arms = (
        positions[index[f"Left{n}"]] + positions[index[f"Right{n}"]] for n in ("UpLeg", "Arm")
    )
    return 0.5 * (arms - hips)


def _pose_positions(
    source: SourceClip, rotations: Float[np.ndarray, "bones 3 3"]
) -> Float[np.ndarray, "bones 3"]:
    position = np.zeros((len(source.names), 3))
    for j, parent in enumerate(source.parents):
        if parent >= 0:
            position[j] = position[parent] + rotations[parent] @ source.offsets[j]
    return position


def limb_directions(
    source: SourceClip,
    index: Mapping[str, int],
    rotations: Float[np.ndarray, "bones 3 3"],
) -> dict[str, Float[np.ndarray, "3"]]:
    """Unit directions of limb bones in a pose of the source skeleton."""
    position = _pose_positions(source, rotations)
    out = {}
    for a, b in LIMBS.items():
        d = position[index[b]] - position[index[a]]
        length = float(np.linalg.norm(d))
        if not SHORTEST < length < LONGEST:
            raise MotionError.at(
                source.path,
                None,
                f"the bone from {source.names[index[a]]} to {source.names[index[b]]} has"
                f" length {length:.3g}" + (": zero" if length < 1 else ""),
                "Fix its OFFSET, or map other joints",
            )
        out[a] = d / length
    return out
