"""From any humanoid skeleton to the body's own."""

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy.spatial.transform import Rotation

from ..body import NUM_BODY_VERTICES, Body, align_global, load_body, smallest_rotation
from ..errors import MotionError
from ._motion import Motion, animate, make_motion
from ._source import SourceClip

_SIDES = (("Left", "l", "L"), ("Right", "r", "R"))
_TRUNK = ("Hips", "LowerBack", "Spine", "Spine1", "Neck", "Neck1", "Head")
_ARM = ("Shoulder", "Arm", "ForeArm", "Hand")
_LEG = ("UpLeg", "Leg", "Foot", "ToeBase")


def _family(
    trunk: tuple[str | None, ...], arm: tuple[str, ...], leg: tuple[str | None, ...]
) -> dict[str, str]:
    """Body joint to source joint; '{S}' is Left or Right, '{s}' is l or r."""
    out = {b: s for b, s in zip(_TRUNK, trunk, strict=True) if s}
    for side, small, _ in _SIDES:
        for names, sources in ((_ARM, arm), (_LEG, leg)):
            for b, s in zip(names, sources, strict=True):
                if s:
                    out[side + b] = s.format(S=side, s=small)
    return out


JOINT_MAPS: dict[str, dict[str, str]] = {
    "cmu-asf": _family(
        ("root", "lowerback", "upperback", "thorax", "lowerneck", "upperneck", "head"),
        ("{s}clavicle", "{s}humerus", "{s}radius", "{s}wrist"),
        ("{s}femur", "{s}tibia", "{s}foot", "{s}toes"),
    ),
    "cmu-motionbuilder": _family(
        _TRUNK,
        tuple("{S}" + n for n in _ARM),
        tuple("{S}" + n for n in _LEG),
    ),
    "cmu-daz": _family(
        ("hip", "abdomen", None, "chest", "neck", None, "head"),
        ("{s}Collar", "{s}Shldr", "{s}ForeArm", "{s}Hand"),
        ("{s}Thigh", "{s}Shin", "{s}Foot", None),
    ),
    "cmu-3dsmax": _family(
        ("Hips", "lowerback", "Chest", "Chest2", "lowerneck", "Neck", "Head"),
        ("{S}Collar", "{S}Shoulder", "{S}Elbow", "{S}Wrist"),
        ("{S}Hip", "{S}Knee", "{S}Ankle", "{S}Toe"),
    ),
}
"""Joint maps by family: body joint to source joint."""

LIMBS = {
    f"{side}{a}": f"{side}{b}"
    for side, _, _ in _SIDES
    for a, b in (("Arm", "ForeArm"), ("ForeArm", "Hand"), ("UpLeg", "Leg"), ("Leg", "Foot"))
}
"""Limb bones: joint at the start, joint at the end."""

# DAZ figures hold their forearms 17 degrees forward in their T-pose.
_T_POSE = float(np.cos(np.radians(25.0)))


def find_joint_map(source: SourceClip) -> tuple[str, dict[str, str]]:
    """The family whose joints the skeleton has.

    Raises:
        MotionError: If none fits; the text lists what is missing from the nearest.
    """
    have = set(source.names)
    missing = {
        family: [s for s in joints.values() if s not in have]
        for family, joints in JOINT_MAPS.items()
    }
    family = min(missing, key=lambda f: len(missing[f]))
    if missing[family]:
        lacks = ", ".join(missing[family][:6])
        raise MotionError.at(
            source.path,
            None,
            f"unknown joints: not one of {', '.join(JOINT_MAPS)}; the nearest,"
            f" {family}, lacks {lacks}",
            "Pass a joint map (joint_map={'Hips': 'your name', …})",
        )
    return family, JOINT_MAPS[family]


def retarget(
    source: SourceClip,
    body: Body | None = None,
    *,
    joint_map: Mapping[str, str] | None = None,
    shape: Float[Array, " shapes"] | None = None,
) -> Motion:
    """The clip on the body's skeleton.

    Rotations are carried over relative to a reference pose in which the source's
    limbs are known: a T-pose in frame 0 if there is one (it is dropped), else the
    skeleton's zero pose with its legs made straight. The body is first put in that
    pose, so its limbs then point exactly where the source's do. Positions are scaled
    by leg length and the clip is lifted so that its lowest point touches the floor.

    Args:
        source: Clip as read.
        body: Body to drive; the built-in one by default.
        joint_map: Body joint to source joint; found by the names if omitted.
        shape: Shape parameters of the body, which set its proportions.

    Returns:
        Motion in metres, Y up.

    Raises:
        MotionError: Unknown joints, a map without the limbs, a limb of length zero.
    """
    body = load_body() if body is None else body
    joints = dict(joint_map) if joint_map is not None else find_joint_map(source)[1]
    needed = {"Hips", *LIMBS, *LIMBS.values()}
    if needed - joints.keys() or joints.keys() - set(body.joint_names):
        raise MotionError.at(
            source.path,
            None,
            f"the joint map lacks {sorted(needed - joints.keys())} and has unknown"
            f" {sorted(joints.keys() - set(body.joint_names))}",
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
    reference, start = _reference(source, index)
    if start >= len(source.root):
        raise MotionError.at(
            source.path, None, "only a T-pose frame, no motion", "Export more frames"
        )
    directions = _limb_directions(source, index, reference)
    aligned = align_global(body, directions, shape)
    world = _world_rotations(body, source, index, reference, aligned, start)
    rest = body.rest_vertices(body.default_shape() if shape is None else shape)
    heads = np.asarray(body.joint_positions(rest)[0], dtype=np.float64)
    at = body.joint_names.index
    legs = [
        np.linalg.norm(heads[at(f"{s}Leg")] - heads[at(f"{s}UpLeg")])
        + np.linalg.norm(heads[at(f"{s}Foot")] - heads[at(f"{s}Leg")])
        for s in ("Left", "Right")
    ]
    positions = source.positions()[start:]
    source_legs = [
        np.linalg.norm(positions[0, index[f"{s}Leg"]] - positions[0, index[f"{s}UpLeg"]])
        + np.linalg.norm(positions[0, index[f"{s}Foot"]] - positions[0, index[f"{s}Leg"]])
        for s in ("Left", "Right")
    ]
    scale = sum(legs) / sum(source_legs)
    hips = [index["LeftUpLeg"], index["RightUpLeg"]]
    middle = 0.5 * (heads[at("LeftUpLeg")] + heads[at("RightUpLeg")]) - heads[0]
    root = scale * positions[:, hips].mean(axis=1) - world[:, 0] @ middle
    local = world.copy()
    for j, parent in enumerate(body.parents):
        if parent >= 0:
            local[:, j] = np.swapaxes(world[:, parent], 1, 2) @ world[:, j]
    quaternions = _continuous(
        Rotation.from_matrix(local.reshape(-1, 3, 3))
        .as_quat(scalar_first=True)
        .reshape(len(root), -1, 4)
    )
    motion = make_motion(quaternions, root, source.fps, name=source.name)
    return stand_on_floor(body, motion, rest)


def stand_on_floor(body: Body, motion: Motion, rest: Float[Array, "all 3"]) -> Motion:
    """The clip lifted or lowered as a whole so that its lowest foot vertex is at y=0."""
    low = float(foot_heights(body, motion, rest).min())
    root = np.asarray(motion.root) - np.array([[0.0, low, 0.0]], np.float32)
    return Motion(motion.rotations, jnp.asarray(root), motion.fps, motion.name)


def foot_heights(
    body: Body, motion: Motion, rest: Float[Array, "all 3"]
) -> Float[np.ndarray, " frames"]:
    """Height of the lowest vertex of both feet in each frame [m]."""
    rows = np.flatnonzero(_foot_vertices(body))
    moved = animate(body, rest, rest[jnp.asarray(rows)], body.weights[jnp.asarray(rows)], motion)
    return np.asarray(moved)[:, :, 1].min(axis=1)


def _foot_vertices(body: Body) -> Bool[np.ndarray, " vertices"]:
    names = ("LeftFoot", "RightFoot", "LeftToeBase", "RightToeBase")
    columns = [body.joint_names.index(n) for n in names]
    weights = np.asarray(body.weights)[:NUM_BODY_VERTICES]
    return weights[:, columns].sum(axis=1) > 0.5


def _reference(
    source: SourceClip, index: Mapping[str, int]
) -> tuple[Float[np.ndarray, "bones 3 3"], int]:
    """World rotations of the reference pose and the first frame of motion."""
    first = source.rotations[0]
    limbs = {k: v for k, v in index.items() if k in LIMBS and LIMBS[k] in index}
    upright = np.abs(first[index["Hips"]] - np.eye(3)).max() < 0.1
    if upright and len(source.root) > 1:
        pointing = _limb_directions(source, index, first)
        sideways = [
            (1.0 if k.startswith("Left") else -1.0) * pointing[k][0] for k in limbs if "Arm" in k
        ]
        down = [-pointing[k][1] for k in limbs if "Leg" in k]
        if min(sideways + down) > _T_POSE:
            return first, 1
    # The zero pose. CMU's skeletons stand astride in it: straighten each leg as one.
    zero = np.tile(np.eye(3), (len(source.names), 1, 1))
    pointing = _limb_directions(source, index, zero)
    for side in ("Left", "Right"):
        turn = smallest_rotation(pointing[f"{side}UpLeg"], np.array([0.0, -1.0, 0.0]))
        member = {index[f"{side}UpLeg"]}
        for j, parent in enumerate(source.parents):
            if parent in member:
                member.add(j)
        for j in member:
            zero[j] = turn.as_matrix()
    return zero, 0


def _limb_directions(
    source: SourceClip,
    index: Mapping[str, int],
    rotations: Float[np.ndarray, "bones 3 3"],
) -> dict[str, Float[np.ndarray, "3"]]:
    """Unit directions of limb bones in a pose of the source skeleton."""
    position = np.zeros((len(source.names), 3))
    for j, parent in enumerate(source.parents):
        if parent >= 0:
            position[j] = position[parent] + rotations[parent] @ source.offsets[j]
    out = {}
    for a, b in LIMBS.items():
        d = position[index[b]] - position[index[a]]
        length = float(np.linalg.norm(d))
        if length < 1e-9:
            raise MotionError.at(
                source.path,
                None,
                f"the bone from {source.names[index[a]]} to {source.names[index[b]]} has"
                " length zero",
                "Fix its OFFSET, or map other joints",
            )
        out[a] = d / length
    return out


def _world_rotations(
    body: Body,
    source: SourceClip,
    index: Mapping[str, int],
    reference: Float[np.ndarray, "bones 3 3"],
    aligned: list[Rotation],
    start: int,
) -> Float[np.ndarray, "frames joints 3 3"]:
    frames = source.rotations[start:]
    world = np.zeros((len(frames), len(body.parents), 3, 3))
    for j, (name, parent) in enumerate(zip(body.joint_names, body.parents, strict=True)):
        if name in index:
            change = frames[:, index[name]] @ reference[index[name]].T
            world[:, j] = change @ aligned[j].as_matrix()
        else:
            relative = aligned[parent].inv() * aligned[j]
            world[:, j] = world[:, parent] @ relative.as_matrix()
    return world


def _continuous(
    q: Float[np.ndarray, "frames joints 4"],
) -> Float[np.ndarray, "frames joints 4"]:
    """Signs chosen so that successive quaternions are near each other."""
    flips = np.sign(np.sum(q[1:] * q[:-1], axis=2, keepdims=True))
    sign = np.cumprod(np.where(flips == 0, 1.0, flips), axis=0)
    return np.concatenate([q[:1], q[1:] * sign])
