"""Reader of glTF skeletons and animations: the joints of a skin, or all rotating nodes."""

import pathlib
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..errors import MotionError, PhysXNetError
from ..io import GLTF_FORMATS, GltfFile, nearest_turns, rest_matrices
from ._source import SourceClip


def read_gltf(path: str | pathlib.Path, animation: str | None = None) -> SourceClip:
    """Reads an animation of a `.glb` or `.gltf` file, without retargeting.

    Args:
        path: The file.
        animation: Name of the animation; the longest by default.

    Returns:
        World rotations and positions of the joints of the largest skin, or of every node
        with an animated rotation and those below it if there is no skin. The rest pose is
        the bind pose of the skin, else that of the static node transforms. Joints that VRM
        declares as humanoid bones take their VRM names.

    Raises:
        MotionError: Damaged files, files without an animation, or a skeleton with zero
            scale. No file outside the folder is opened, and nothing is downloaded.
        MissingDependencyError: Without pygltflib.

    References:
        Khronos, glTF 2.0, sections 3.7.3 (skins) and 3.11 (animations).
    """
    try:
        return _read(pathlib.Path(path), animation)
    except (PhysXNetError, OSError):
        raise
    # pygltflib doesn't check the types of the JSON's values.
    except (TypeError, ValueError, AttributeError, LookupError, OverflowError) as error:
        raise MotionError.at(
            path,
            None,
            f"damaged glTF ({type(error).__name__}: {error})"[:300],
            "Export it again",
        ) from error


def _read(path: pathlib.Path, animation: str | None) -> SourceClip:
    file = GltfFile(path)
    chosen = file.animation(animation)
    times, fps = file.frame_times(chosen)
    nodes = skeleton_nodes(file, chosen)
    rest = rest_matrices(file)
    rest = file.world()[0] if rest is None else rest
    return _clip(file, nodes, file.world(times, chosen)[:, nodes], fps, rest)


def split_animation(path: str | pathlib.Path) -> tuple[pathlib.Path, str | None]:
    """Splits ``FILE#ANIMATION`` into the file and the animation's name, None without one."""
    file, _, name = str(path).rpartition("#")
    if file and pathlib.Path(file).suffix.lower() in GLTF_FORMATS:
        return pathlib.Path(file), name
    return pathlib.Path(path), None


def other_animations(path: pathlib.Path) -> tuple[str, list[str]]:
    """The animation of a file that is read by default, and the names of the others."""
    file = GltfFile(path)
    names = file.animation_names()
    if len(names) < 2:
        return "", []
    chosen = names[file.animation()]
    return chosen, [n for n in names if n != chosen]


class Rig(NamedTuple):
    """A file's skeleton at rest.

    Attributes:
        clip: A clip of one frame.
        nodes: Node of each joint.
        rest: World matrices of all nodes in the bind pose, None if the nodes stand in it.
    """

    clip: SourceClip
    nodes: list[int]
    rest: Float[np.ndarray, "nodes 4 4"] | None


def read_rig(file: GltfFile) -> Rig:
    """Reads a file's skeleton in its bind pose.

    Raises:
        MotionError: No skeleton, or one with zero scale.
    """
    nodes = skeleton_nodes(file)
    bound = rest_matrices(file)
    rest = file.world()[0] if bound is None else bound
    return Rig(_clip(file, nodes, rest[None, nodes], 30.0, rest), nodes, bound)


def _clip(
    file: GltfFile,
    nodes: list[int],
    moving: Float[np.ndarray, "frames joints 4 4"],
    fps: float,
    rest_world: Float[np.ndarray, "nodes 4 4"],
) -> SourceClip:
    bones = file.bones()
    taken = set(bones.values())
    names = []
    for n in nodes:
        own = str(file.document.nodes[n].name or f"node{n}").split(":")[-1]
        names.append(bones.get(n, f"{own} (node {n})" if own in taken else own))
    if len(set(names)) < len(names):
        raise MotionError.at(file.path, None, "two joints have the same name", "Rename one")
    parents = skeleton_parents(file, nodes)
    static = rest_world[None, nodes]
    rotations, rest = _turns(file, moving), _turns(file, static)[0]
    return SourceClip(
        tuple(names),
        tuple(parents),
        _in_parents(rest[None], static[:, :, :3, 3], parents)[0],
        rotations,
        moving[:, 0, :3, 3],
        fps,
        file.path.stem,
        str(file.path),
        rest,
        _in_parents(rotations, moving[:, :, :3, 3], parents),
    )


def skeleton_nodes(file: GltfFile, animation: int = 0) -> list[int]:
    """Joints of the largest skin and VRM bones, or all rotating nodes; parents first."""
    document = file.document
    if document.skins:
        most = max(document.skins, key=lambda skin: len(skin.joints))
        wanted = {file.index(j, document.nodes, "joint") for j in most.joints} | set(file.bones())
    else:
        moving = document.animations[animation] if document.animations else None
        wanted = {
            file.index(c.target.node, document.nodes, "node")
            for c in (moving.channels if moving else ())
            if c.target.path == "rotation" and c.target.node is not None
        }
        wanted |= _below(file, wanted)
    nodes = [n for n in file.order if n in wanted]
    if len(nodes) < 2:
        raise MotionError.at(file.path, None, "no skeleton", "Export it with its skin")
    return nodes


def _below(file: GltfFile, moving: set[int]) -> set[int]:
    """Nodes below animated ones that may be joints without keys: named, and unlike others."""
    nodes = file.document.nodes
    names = {str(nodes[n].name) for n in moving}
    inside, out = set(moving), set()
    for n in file.order:
        if n in inside or int(file.parents[n]) not in inside:
            continue
        inside.add(n)
        name = str(nodes[n].name or "")
        if name and name not in names and nodes[n].mesh is None and nodes[n].camera is None:
            names.add(name)
            out.add(n)
    return out


def skeleton_parents(file: GltfFile, nodes: list[int]) -> list[int]:
    """Nearest ancestor among the joints; the first joint for those without one."""
    place = {n: k for k, n in enumerate(nodes)}
    out = []
    for k, n in enumerate(nodes):
        above = int(file.parents[n])
        while above >= 0 and above not in place:
            above = int(file.parents[above])
        out.append(place[above] if above >= 0 else (-1 if k == 0 else 0))
    return out


def _turns(
    file: GltfFile, matrices: Float[np.ndarray, "frames joints 4 4"]
) -> Float[np.ndarray, "frames joints 3 3"]:
    """Rotations nearest to matrices that may include scale."""
    try:
        return nearest_turns(matrices[:, :, :3, :3])
    except ValueError as error:
        raise file.broken(str(error)) from None


def _in_parents(
    rotations: Float[np.ndarray, "frames joints 3 3"],
    positions: Float[np.ndarray, "frames joints 3"],
    parents: list[int],
) -> Float[np.ndarray, "frames joints 3"]:
    out = np.zeros_like(positions)
    for j, parent in enumerate(parents):
        if parent >= 0:
            step = positions[:, j] - positions[:, parent]
            out[:, j] = np.einsum("fba,fb->fa", rotations[:, parent], step)
    return out
