"""Retargeting from the body's skeleton to another rig, the inverse of `retarget`."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from ..body import Body, align_global, load_body
from ..io import GltfFile
from ._gltf import read_rig
from ._motion import Motion
from ._reference import limb_directions, reference_pose, upright
from ._retarget import joint_index, leg_length
from ._transforms import clip_transforms


def retarget_to_rig(
    file: GltfFile,
    motion: Motion,
    *,
    body: Body | None = None,
    joint_map: Mapping[str, str] | None = None,
) -> Float[np.ndarray, "frames nodes 4 4"]:
    """Retargets a motion of the body to the skeleton of a rigged character.

    The inverse of `retarget`: limbs point where the body's do, joints that the body lacks
    (twist bones, fingers, hair) keep their transform relative to their parent, and steps
    are scaled by leg length.

    Args:
        file: A glTF with a skin whose joint names are known, or VRM.
        motion: The clip.
        body: The body of the motion; the built-in one by default.
        joint_map: Body joint to the file's joint, for unknown names.

    Returns:
        World matrices of all nodes, in the file's unit, Y up.

    Raises:
        MotionError: No skeleton, unknown joints, or a limb of length zero.
    """
    body = load_body() if body is None else body
    rig, nodes, bound = read_rig(file)
    index = joint_index(rig, body, joint_map)
    rig = upright(rig, index)
    reference, _, stance, _, _ = reference_pose(rig, index)
    directions = limb_directions(rig, index, reference)
    aligned = align_global(body, {k: stance.T @ d for k, d in directions.items()})
    rest = body.rest_vertices(body.default_shape())
    world, shift = (np.asarray(x, np.float64) for x in clip_transforms(body, rest, motion))
    turns = {}
    for name, joint in index.items():
        j = body.joint(name)
        from_body = (Rotation.from_matrix(stance) * aligned[j]).inv().as_matrix()
        turns[nodes[joint]] = world[:, j] @ from_body @ reference[joint]
    out = file.posed(turns, bound)
    heads = np.asarray(body.joint_positions(rest)[0], np.float64)
    scale = leg_length(rig.positions()[0], index.__getitem__) / leg_length(heads, body.joint)
    thighs = [body.joint("LeftUpLeg"), body.joint("RightUpLeg")]
    goal = np.einsum("fjab,jb->fja", world[:, thighs], heads[thighs]) + shift[:, thighs]
    there = out[..., :3, 3][:, [nodes[index["LeftUpLeg"]], nodes[index["RightUpLeg"]]]]
    out[:, :, :3, 3] += (scale * goal.mean(axis=1) - there.mean(axis=1))[:, None]
    return out
