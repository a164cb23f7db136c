"""Reader of glTF animations: the skeleton of a skin, or of all that turns."""

import pathlib

import numpy as np
from jaxtyping import Float

from ..errors import MotionError, PhysXNetError
from ._gltf_file import GltfFile
from ._source import SourceClip


def read_gltf(path: str | pathlib.Path) -> SourceClip:
    """The first animation of a `.glb` or `.gltf` file, before retargeting.

    Args:
        path: The file.

    Returns:
        World rotations and positions of the first skin's joints, or of every node that
        is animated if there is no skin. The nodes as they stand in the file are the rest
        pose.

    Raises:
        MotionError: Damaged files, files without an animation, a skeleton scaled to
            nothing. No file outside the folder is opened and nothing is downloaded.
        MissingDependencyError: Without pygltflib.

    References:
        Khronos, glTF 2.0, sections 3.7.3 (skins) and 3.11 (animations).
    """
    try:
        return _read(pathlib.Path(path))
    except (PhysXNetError, OSError):
        raise
    # The library hands on whatever kinds of values the JSON has.
    except (TypeError, ValueError, AttributeError, LookupError, OverflowError) as error:
        raise MotionError.at(
            path,
            None,
            f"damaged glTF ({type(error).__name__}: {error})"[:300],
            "Export it again",
        ) from error


def _read(path: pathlib.Path) -> SourceClip:
    file = GltfFile(path)
    times, fps = file.frame_times()
    nodes = skeleton_nodes(file)
    names = [str(file.document.nodes[n].name or f"node{n}").split(":")[-1] for n in nodes]
    if len(set(names)) < len(names):
        raise MotionError.at(path, None, "two joints of one name", "Rename one")
    parents = skeleton_parents(file, nodes)
    moving, still = file.world(times)[:, nodes], file.world()[:, nodes]
    rotations, rest = _turns(file, moving), _turns(file, still)[0]
    return SourceClip(
        tuple(names),
        tuple(parents),
        _in_parents(rest[None], still[:, :, :3, 3], parents)[0],
        rotations,
        moving[:, 0, :3, 3],
        fps,
        path.stem,
        str(path),
        rest,
        _in_parents(rotations, moving[:, :, :3, 3], parents),
    )


def skeleton_nodes(file: GltfFile) -> list[int]:
    """Nodes of the first skin's joints, or all that turn; parents first."""
    document = file.document
    if document.skins:
        wanted = {file.index(j, document.nodes, "joint") for j in document.skins[0].joints}
    else:
        wanted = {
            file.index(c.target.node, document.nodes, "node")
            for c in document.animations[0].channels
            if c.target.path == "rotation" and c.target.node is not None
        }
    nodes = [n for n in file.order if n in wanted]
    if len(nodes) < 2:
        raise MotionError.at(file.path, None, "no skeleton", "Export it with its skin")
    return nodes


def skeleton_parents(file: GltfFile, nodes: list[int]) -> list[int]:
    """Nearest joint above each; the first one for those that hang elsewhere."""
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
    """Rotations nearest to the matrices, which may scale."""
    u, scales, v = np.linalg.svd(matrices[:, :, :3, :3])
    if (scales[..., 2] < 1e-9).any():
        raise file.broken("a joint is scaled to nothing")
    turn = u @ v
    flip = np.linalg.det(turn) < 0
    u[..., 2] = np.where(flip[..., None], -u[..., 2], u[..., 2])
    return u @ v


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
