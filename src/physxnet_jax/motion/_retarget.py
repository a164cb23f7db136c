"""Retargeting from any humanoid skeleton to the body's."""

from collections.abc import Callable, Mapping

import jax
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy.spatial.transform import Rotation

from ..body import NUM_BODY_VERTICES, Body, align_global, load_body
from ..errors import MotionError
from ._motion import Motion, animation_blocks, make_motion
from ._reference import LONGEST, SHORTEST, limb_directions, reference_pose, upright
from ._skeletons import NEEDED, find_joint_map, nearest_joint_map
from ._source import SourceClip

# Longest blend from a T-pose at a clip's start [s], and how much faster it turns than the 95th
# percentile of the clip (factor).
_MAX_BLEND, _BLEND_SPEED = 0.25, 1.5
# Frames that are retargeted at once.
_PART = 4096
# Share of frames that may go through the floor [1], by more than this [m].
_ODD_FRAMES, THROUGH = 0.05, 0.03


def retarget(
    source: SourceClip,
    body: Body | None = None,
    *,
    joint_map: Mapping[str, str] | None = None,
    shape: Float[Array, " shapes"] | None = None,
) -> Motion:
    """Retargets a clip to the body's skeleton.

    Rotations are transferred relative to a reference pose in which the directions of the
    source's limbs are known. It is the first of these that exists:

    * a T-pose in frame 0, which is then dropped;
    * the rest pose with its legs turned to vertical, if it is a standing pose (a skeleton that
      stands along Z is turned upright);
    * the frame in which the person stands straightest.

    The body is first put in that pose, so that its limbs point exactly where the source's
    do. Positions are scaled by leg length, and the clip is moved vertically so that the
    feet's lowest vertex touches the floor.

    Args:
        source: Clip as read from a file.
        body: Body to drive; the built-in one by default.
        joint_map: Body joint to source joint; matched by name if omitted.
        shape: Shape parameters of the body, which set its proportions.

    Returns:
        Motion in metres, Y up.

    Raises:
        MotionError: Unknown joints, a joint map without the limbs, or a limb of length zero.
    """
    body = load_body() if body is None else body
    index = joint_index(source, body, joint_map)
    source = upright(source, index)
    reference, start, stance, twist, _ = reference_pose(source, index)
    if start >= len(source.root):
        raise MotionError.at(
            source.path, None, "only a T-pose frame, no motion", "Export more frames"
        )
    directions = limb_directions(source, index, reference)
    aligned = align_global(body, {k: stance.T @ d for k, d in directions.items()}, shape)
    aligned = _twisted(body, [Rotation.from_matrix(stance) * a for a in aligned], stance, twist)
    rest = body.rest_vertices(body.default_shape() if shape is None else shape)
    heads = np.asarray(body.joint_positions(rest)[0], dtype=np.float64)
    at = body.joint_names.index
    first = source.part(start, start + 1)
    legs = leg_length(first.positions()[0], index.__getitem__)
    if not SHORTEST < legs < LONGEST:
        raise MotionError.at(
            source.path,
            None,
            f"legs {legs:.3g} units long in its first frame",
            "Export it again, or map other joints",
        )
    scale = leg_length(heads, at) / legs
    hips = [index["LeftUpLeg"], index["RightUpLeg"]]
    middle = 0.5 * (heads[at("LeftUpLeg")] + heads[at("RightUpLeg")]) - heads[0]
    frames = len(source.root) - start
    quaternions, root = np.empty((frames, len(body.parents), 4)), np.empty((frames, 3))
    # By parts: matrices take several times what quaternions take.
    for at in range(0, frames, _PART):
        part = source.part(start + at, start + at + _PART)
        world = _world_rotations(body, part, index, reference, aligned)
        rows = slice(at, at + len(world))
        root[rows] = scale * part.positions()[:, hips].mean(axis=1) - world[:, 0] @ middle
        quaternions[rows] = _local_quaternions(body, world)
    continuous(quaternions)
    if start:
        quaternions, root = _without_t_pose_blend(quaternions, root, source.fps)
    motion = make_motion(quaternions, root, source.fps, name=source.name)
    return stand_on_floor(body, motion, rest)


def _twisted(
    body: Body, aligned: list[Rotation], stance: Float[np.ndarray, "3 3"], twist: float
) -> list[Rotation]:
    """Spreads the twist of the reference pose over the trunk, up to the shoulders.

    Arms and legs keep the directions that they were given.
    """
    if twist == 0.0:
        return aligned
    spine = ("LowerBack", "Spine", "Spine1")
    share = {name: (k + 1) / len(spine) for k, name in enumerate(spine)}
    out = list(aligned)
    shares = np.zeros(len(out))
    for j, (name, parent) in enumerate(zip(body.joint_names, body.parents, strict=True)):
        shares[j] = share.get(name, shares[parent] if parent >= 0 else 0.0)
        free = not name.startswith(("LeftArm", "RightArm", "LeftFore", "RightFore"))
        if shares[j] and free:
            out[j] = Rotation.from_rotvec(shares[j] * twist * stance[:, 1]) * aligned[j]
    return out


def _without_t_pose_blend(
    q: Float[np.ndarray, "frames joints 4"], root: Float[np.ndarray, "frames 3"], fps: float
) -> tuple[Float[np.ndarray, "frames joints 4"], Float[np.ndarray, "frames 3"]]:
    """Removes the blend from a T-pose at the start of a converted clip.

    Such clips blend from the T-pose to the motion within a few frames. These are replaced by
    the first frame after them, so the number of frames stays the same.
    """
    turned = 2.0 * np.arccos(np.clip(np.abs(np.sum(q[1:] * q[:-1], axis=2)), 0.0, 1.0)).max(axis=1)
    few = min(int(_MAX_BLEND * fps), len(turned) // 3)
    usual = np.quantile(turned[few:], 0.95) if few else np.inf
    settled = int(np.argmax(np.append(turned[:few] <= _BLEND_SPEED * usual, True)))
    if settled:
        q, root = q.copy(), root.copy()
        q[:settled], root[:settled] = q[settled], root[settled]
    return q, root


def joint_index(
    source: SourceClip, body: Body, joint_map: Mapping[str, str] | None = None
) -> dict[str, int]:
    """Body joint to index of the skeleton's joint, by the joint map and by known names.

    Joints missing from the map are taken from the nearest family if the skeleton has them.

    Raises:
        MotionError: Unknown joints, or a joint map without the limbs.
    """
    if joint_map is None:
        joints = find_joint_map(source)[1]
    else:
        mapped = set(joint_map.values())
        known = nearest_joint_map(source)[1]
        joints = {b: s for b, s in known.items() if s not in mapped} | dict(joint_map)
    lacking, unknown = NEEDED - joints.keys(), joints.keys() - set(body.joint_names)
    if lacking or unknown:
        wrong = [f"lacks {', '.join(sorted(lacking))}"] if lacking else []
        wrong += [f"has {', '.join(sorted(unknown))}, which the body lacks"] if unknown else []
        raise MotionError.at(
            source.path,
            None,
            f"the joint map {' and '.join(wrong)}",
            f"Map at least the limbs; the body has {', '.join(body.joint_names)}",
        )
    index = {}
    for b, s in joints.items():
        if s not in source.names:
            raise MotionError.at(
                source.path,
                None,
                f"the skeleton has no joint '{s}' (for {b})",
                f"It has: {', '.join(source.names[:40])}",
            )
        index[b] = source.names.index(s)
    return index


def leg_length(positions: Float[np.ndarray, "joints 3"], place: Callable[[str], int]) -> float:
    """Total length of both legs from hip to ankle; `place` maps joint names to rows."""
    ways = [
        positions[place(f"{side}{low}")] - positions[place(f"{side}{high}")]
        for side in ("Left", "Right")
        for high, low in (("UpLeg", "Leg"), ("Leg", "Foot"))
    ]
    return float(np.linalg.norm(ways, axis=1).sum())


def stand_on_floor(body: Body, motion: Motion, rest: Float[Array, "all 3"]) -> Motion:
    """Moves the whole clip vertically so that its lowest foot vertex is at y=0.

    Odd frames in which a foot goes through the floor don't count.
    """
    heights = foot_heights(body, motion, rest)
    low, usual = float(heights.min()), float(np.quantile(heights, _ODD_FRAMES))
    low = usual if usual - low > THROUGH else low
    root = np.asarray(motion.root) - np.array([[0.0, low, 0.0]], np.float32)
    return Motion(motion.rotations, jax.device_put(root), motion.fps, motion.name)


def foot_heights(
    body: Body, motion: Motion, rest: Float[Array, "all 3"]
) -> Float[np.ndarray, " frames"]:
    """Height of the lowest vertex of both feet in each frame [m]."""
    rows = np.flatnonzero(_foot_vertices(body))
    feet, weights = (jax.device_put(np.asarray(x)[rows]) for x in (rest, body.weights))
    blocks = animation_blocks(body, rest, feet, weights, motion)
    return np.concatenate([x[:, :, 1].min(axis=1) for x in blocks])


def _foot_vertices(body: Body) -> Bool[np.ndarray, " vertices"]:
    names = ("LeftFoot", "RightFoot", "LeftToeBase", "RightToeBase")
    columns = [body.joint_names.index(n) for n in names]
    weights = np.asarray(body.weights)[:NUM_BODY_VERTICES]
    return weights[:, columns].sum(axis=1) > 0.5


def _world_rotations(
    body: Body,
    source: SourceClip,
    index: Mapping[str, int],
    reference: Float[np.ndarray, "bones 3 3"],
    aligned: list[Rotation],
) -> Float[np.ndarray, "frames joints 3 3"]:
    frames = source.rotations
    world = np.zeros((len(frames), len(body.parents), 3, 3))
    for j, (name, parent) in enumerate(zip(body.joint_names, body.parents, strict=True)):
        if name in index:
            change = frames[:, index[name]] @ reference[index[name]].T
            world[:, j] = change @ aligned[j].as_matrix()
        else:
            relative = aligned[parent].inv() * aligned[j]
            world[:, j] = world[:, parent] @ relative.as_matrix()
    return world


def _local_quaternions(
    body: Body, world: Float[np.ndarray, "frames joints 3 3"]
) -> Float[np.ndarray, "frames joints 4"]:
    local = world.copy()
    for j, parent in enumerate(body.parents):
        if parent >= 0:
            local[:, j] = np.swapaxes(world[:, parent], 1, 2) @ world[:, j]
    turns = Rotation.from_matrix(local.reshape(-1, 3, 3)).as_quat(scalar_first=True)
    return turns.reshape(*world.shape[:2], 4)


def continuous(
    q: Float[np.ndarray, "frames joints 4"],
) -> Float[np.ndarray, "frames joints 4"]:
    """Flips signs in place so that successive quaternions are near each other; returns them."""
    apart = np.einsum("fjc,fjc->fj", q[1:], q[:-1]) < 0.0
    q[1:][np.logical_xor.accumulate(apart, axis=0)] *= -1.0
    return q
