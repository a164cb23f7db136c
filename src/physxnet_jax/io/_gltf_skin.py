"""Bind poses of glTF skins, which are the rest pose of a rig that was saved in another."""

import numpy as np
from jaxtyping import Float

from ..errors import FormatError
from ._gltf_file import GltfFile

# Bind matrices and node transforms that agree to this share of the skeleton are one pose.
_SAME = 1e-3


def skin_joints(file: GltfFile, which: object) -> list[int]:
    """Nodes of a skin's joints.

    Raises:
        FormatError: The skin has no joints, or lists one twice.
    """
    skin = file.document.skins[file.index(which, file.document.skins, "skin")]
    joints = [file.index(j, file.document.nodes, "joint") for j in skin.joints]
    if len(set(joints)) < len(joints) or not joints:
        raise FormatError(f"{file.path}: a skin has no joints, or lists a joint twice.")
    return joints


def inverse_binds(file: GltfFile, which: int) -> Float[np.ndarray, "joints 4 4"]:
    """Inverse bind matrices of a skin; identities if it has none.

    Raises:
        FormatError: They don't fit the joints.
    """
    skin, count = file.document.skins[which], len(skin_joints(file, which))
    if skin.inverseBindMatrices is None:
        return np.tile(np.eye(4), (count, 1, 1))
    entry = np.asarray(file.accessor(skin.inverseBindMatrices), float)
    if entry.shape != (count, 16) or not np.isfinite(entry).all():
        raise FormatError(f"{file.path}: bind matrices of skin {which} don't fit its joints.")
    return entry.reshape(-1, 4, 4).swapaxes(1, 2)


def bind_place(
    file: GltfFile,
    which: int,
    node: int | None,
    still: Float[np.ndarray, "nodes 4 4"],
    binds: Float[np.ndarray, "joints 4 4"],
) -> Float[np.ndarray, "4 4"]:
    """Matrix from a skin's bind space to the world.

    It places the topmost joint where its node stands. If the rig was saved in another pose
    than the bind pose, that joint may lean: then the mesh's own node places it, if its scale
    is the same.

    Args:
        file: The file.
        which: The skin.
        node: Node of a mesh with this skin.
        still: World matrices of all nodes at rest.
        binds: Inverse bind matrices.
    """
    joints = skin_joints(file, which)
    rank = {n: k for k, n in enumerate(file.order)}
    top = min(range(len(joints)), key=lambda k: rank[joints[k]])
    place = still[joints[top]] @ binds[top]
    if node is None or _is_bind_pose(still[joints] @ binds, binds):
        return place
    own = still[node]
    size, expected = (abs(float(np.linalg.det(m[:3, :3]))) for m in (own, place))
    return own if abs(size - expected) < 0.03 * expected else place


def _is_bind_pose(
    matrices: Float[np.ndarray, "joints 4 4"], binds: Float[np.ndarray, "joints 4 4"]
) -> bool:
    """Whether all joints place the bind pose alike."""
    with np.errstate(all="ignore"):
        heads = np.linalg.pinv(binds)[:, :3, 3]
        size = max(float(np.ptp(heads, axis=0).max(initial=0.0)), 1e-9)
        # The corners of a box around the skeleton, as each joint places them.
        corners = heads.mean(axis=0) + size * np.concatenate([np.eye(3), -np.eye(3)])
        placed = np.einsum("jab,cb->jca", matrices[:, :3, :3], corners) + matrices[:, None, :3, 3]
        scale = np.cbrt(abs(np.linalg.det(matrices[0, :3, :3])))
        return bool(np.abs(placed - placed[:1]).max() < _SAME * size * max(scale, 1e-12))


def rest_matrices(file: GltfFile) -> Float[np.ndarray, "nodes 4 4"] | None:
    """World matrices of all nodes in the bind pose of the skins.

    Returns:
        The matrices; None if the nodes stand in the bind pose already, if there is no skin,
        or if bones would change their length, as they do if bind matrices are meaningless.

    References:
        Khronos, glTF 2.0, section 3.7.3 (skins): ``inverseBindMatrices``.
    """
    document, still = file.document, file.world()[0]
    bound: dict[int, np.ndarray] = {}
    moved = False
    users = {n.skin: k for k, n in reversed(list(enumerate(document.nodes))) if n.skin is not None}
    by_size = sorted(range(len(document.skins or ())), key=lambda k: -len(document.skins[k].joints))
    for which in by_size:
        if document.skins[which].inverseBindMatrices is None:
            continue
        joints, binds = skin_joints(file, which), inverse_binds(file, which)
        if (np.abs(np.linalg.det(binds)) < 1e-18).any():
            return None
        moved = moved or not _is_bind_pose(still[joints] @ binds, binds)
        place = bind_place(file, which, users.get(which), still, binds)
        for j, matrix in zip(joints, place @ np.linalg.inv(binds), strict=True):
            bound.setdefault(j, matrix)
    if not moved:
        return None
    out = still.copy()
    for n in file.order:
        parent = int(file.parents[n])
        if n in bound:
            out[n] = bound[n]
        elif parent >= 0:
            out[n] = out[parent] @ np.linalg.pinv(still[parent]) @ still[n]
    before, after = (_bone_lengths(file, m, list(bound)) for m in (still, out))
    return (
        out if np.abs(before - after).max(initial=0.0) < 0.02 * before.max(initial=1e-9) else None
    )


def _bone_lengths(
    file: GltfFile, world: Float[np.ndarray, "nodes 4 4"], joints: list[int]
) -> Float[np.ndarray, " bones"]:
    own = set(joints)
    pairs = [(j, int(file.parents[j])) for j in joints if int(file.parents[j]) in own]
    return np.array([np.linalg.norm(world[a, :3, 3] - world[b, :3, 3]) for a, b in pairs])
