"""Reads animated meshes of glTF files: skins and morph targets."""

import contextlib
import dataclasses
import pathlib
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from ..errors import FormatError, PhysXNetError
from ..geometry import Polygons, make_material, make_texture
from ._gltf_file import GltfFile
from ._gltf_skin import bind_place, inverse_binds, skin_joints
from ._source_mesh import SourceMesh, welded
from ._uv_transform import make_uv_transform, moved

_TRIANGLES = 4
# Largest number of coordinates to compute.
_MOST = 3e8
# Largest number of node matrices, frames times nodes: an hour of 50 nodes at 30 fps.
_MAX_NODE_MATRICES = 6e6


def read_gltf_meshes(
    path: pathlib.Path,
    fps: float,
    *,
    animation: str | None = None,
) -> tuple[list[SourceMesh], float | None, str | None]:
    """Reads every skinned mesh of an animated file; all meshes if none is skinned.

    Args:
        path: The file.
        fps: Frames per second at which the animation is sampled.
        animation: Its name; the longest if omitted.

    Returns:
        The meshes, their frame rate, and the up axis.

    Raises:
        FormatError: A mesh has no triangles, or its weights don't fit.
        MotionError: The file is damaged.

    References:
        Khronos, glTF 2.0, sections 3.7.2 (meshes) and 3.7.3 (skins).
    """
    with _report_damage(path):
        file = GltfFile(path)
        chosen = file.animation(animation)
        times = file.frame_times(chosen, rate=fps)[0]
        parts = _read(file, times, len(times), lambda: file.world(times, chosen), chosen)
        moving = [p for p in parts if p.bind is not None] or parts
        return [welded(p) for p in moving], float(fps), "Y"


def read_posed_gltf(
    path: pathlib.Path,
    frames: int,
    pose: Callable[[GltfFile], Float[np.ndarray, "frames nodes 4 4"]],
) -> tuple[list[SourceMesh], Float[np.ndarray, "frames nodes 4 4"]]:
    """Reads every skinned mesh of a file in other poses; the lowest point is put on the floor.

    Args:
        path: The file.
        frames: Number of frames of `pose`.
        pose: Computes world matrices of all nodes.

    Returns:
        The meshes, and the world matrices with the person on the floor.

    Raises:
        FormatError: A mesh has no triangles, or its weights don't fit.
        MotionError: The file is damaged.
    """
    with _report_damage(path):
        file = GltfFile(path)
        world: list[np.ndarray] = []

        def placed() -> Float[np.ndarray, "frames nodes 4 4"]:
            world.append(pose(file))
            return world[0]

        parts = [p for p in _read(file, None, frames, placed) if p.bind is not None]
        low = min((float(p.positions[..., 1].min()) for p in parts), default=0.0)
        shift = np.array([0.0, low, 0.0], np.float32)
        moved = [dataclasses.replace(p, positions=p.positions - shift) for p in parts]
        world[0][..., 1, 3] -= low
        return [welded(p) for p in moved], world[0]


def read_gltf_still(path: pathlib.Path) -> list[SourceMesh]:
    """Reads every mesh of a file at rest: static node transforms, skins in their bind pose.

    Raises:
        FormatError: A mesh has no triangles, or its skin weights don't fit.
        MotionError: The file is damaged.
    """
    with _report_damage(path):
        file = GltfFile(path)
        return _read(file, None, 1, file.world)


@contextlib.contextmanager
def _report_damage(path: pathlib.Path) -> Iterator[None]:
    try:
        yield
    except (PhysXNetError, OSError):
        raise
    except (TypeError, ValueError, AttributeError, LookupError, OverflowError) as error:
        raise FormatError(
            f"{path}: damaged glTF ({type(error).__name__}: {error})"[:300]
        ) from error


def _read(
    file: GltfFile,
    times: Float[np.ndarray, " frames"] | None,
    count: int,
    place: Callable[[], Float[np.ndarray, "frames nodes 4 4"]],
    animation: int | None = None,
) -> list[SourceMesh]:
    """Reads meshes over `count` frames, with node matrices of `place` and morphs at `times`."""
    if count * len(file.document.nodes) > _MAX_NODE_MATRICES:
        raise FormatError(
            f"{file.path}: {count:,} frames of {len(file.document.nodes)} nodes exceed the"
            " limit. Export a part of the clip, or the person alone."
        )
    still, world = file.world()[0], place()
    parts: list[SourceMesh] = []
    points = 0
    for n, node in enumerate(file.document.nodes):
        if node.mesh is None:
            continue
        mesh = file.document.meshes[file.index(node.mesh, file.document.meshes, "mesh")]
        weights = file.morph_weights(n, times, animation)
        for primitive in mesh.primitives:
            if (primitive.mode if primitive.mode is not None else _TRIANGLES) != _TRIANGLES:
                continue
            name = str(node.name or mesh.name or f"mesh{node.mesh}")
            part = _primitive(file, primitive, name, weights)
            points += part.positions.shape[1]
            _check_size(file, count, points)
            if node.skin is not None:
                part = _skinned(file, node.skin, n, primitive, part, world, still)
            else:
                part = _transformed(file, part, world[:, n])
            parts.append(part)
    return parts


def _primitive(
    file: GltfFile,
    primitive: object,
    name: str,
    weights: Float[np.ndarray, "frames targets"] | None,
) -> SourceMesh:
    attributes = primitive.attributes  # pyright: ignore[reportAttributeAccessIssue]
    x = np.asarray(file.accessor(attributes.POSITION), np.float32)
    if x.ndim != 2 or x.shape[1] != 3:
        raise FormatError(f"{file.path}: positions of '{name}' aren't points.")
    if primitive.indices is None:  # pyright: ignore[reportAttributeAccessIssue]
        faces = np.arange(len(x) // 3 * 3)
    else:
        faces = np.asarray(file.accessor(primitive.indices))  # pyright: ignore[reportAttributeAccessIssue]
    whole = faces.ndim == 1 and len(faces) > 0 and len(faces) % 3 == 0
    if not whole or faces.min() < 0 or faces.max() >= len(x):
        raise FormatError(f"{file.path}: faces of '{name}' aren't triangles over its vertices.")
    faces = faces.reshape(-1, 3).astype(np.int32)
    positions = x[None]
    targets = primitive.targets or ()  # pyright: ignore[reportAttributeAccessIssue]
    if weights is not None and len(targets):
        _check_size(file, max(len(weights), len(targets)), len(x))
        offsets = np.zeros((len(targets), *x.shape), np.float32)
        for k, target in enumerate(targets):
            which = target["POSITION"] if isinstance(target, dict) else target.POSITION
            if which is not None:
                offsets[k] = file.accessor(which)
        if weights.shape[1] != len(targets):
            raise FormatError(f"{file.path}: {len(targets)} morph targets of '{name}' don't fit.")
        positions = x + np.einsum("ft,tvc->fvc", weights.astype(np.float32), offsets)
    uv = _uv_transform(file, primitive, len(x))
    drawn = _polygons(file, primitive, faces, textured=uv is not None)
    return SourceMesh(name, positions, faces, uv, None if uv is None else faces, polygons=drawn)


def _uv_transform(
    file: GltfFile, primitive: Any, count: int
) -> Float[np.ndarray, "vertices 2"] | None:
    """Transformed texture coordinates of the material's image, or of set 0 without one."""
    image = _image(_material(file, primitive))
    entry = _uv_accessor(primitive, image)
    entry = primitive.attributes.TEXCOORD_0 if entry is None else entry
    if entry is None:
        return None
    uv = np.asarray(file.accessor(entry), float)
    if uv.shape != (count, 2):
        return None
    entry = {} if image is None else _transform(image)
    turned = entry.get("rotation", 0.0)
    # Implementations rotate from v to u, unlike the specification's sample code
    # (KhronosGroup/glTF#1563).
    move = make_uv_transform(
        entry.get("scale", (1.0, 1.0)),
        entry.get("offset", (0.0, 0.0)),
        -turned if isinstance(turned, int | float) else 0.0,
    )
    uv = uv if move is None else moved(uv, move)
    # In glTF, texture coordinates start at the top of the image.
    return uv * [1.0, -1.0] + [0.0, 1.0]


def _uv_accessor(primitive: Any, image: Any) -> int | None:
    """Accessor of the texture coordinates of an image; None if it is missing."""
    which = 0 if image is None else _transform(image).get("texCoord", image.texCoord) or 0
    return getattr(primitive.attributes, f"TEXCOORD_{which}", None)


def _transform(image: Any) -> dict[str, Any]:
    """The KHR_texture_transform of an image, empty without one."""
    entry = (image.extensions or {}).get("KHR_texture_transform")
    return entry if isinstance(entry, dict) else {}


def _material(file: GltfFile, primitive: Any) -> Any:
    which, there = primitive.material, file.document.materials
    return None if which is None else there[file.index(which, there, "material")]


def _image(material: Any) -> Any:
    plain = None if material is None else material.pbrMetallicRoughness
    return None if plain is None else plain.baseColorTexture


def _polygons(
    file: GltfFile, primitive: Any, faces: Int[np.ndarray, "faces 3"], *, textured: bool
) -> Polygons:
    """Triangles with the material of their primitive."""
    count, materials = len(faces), ()
    entry = _material(file, primitive)
    if entry is not None:
        plain = entry.pbrMetallicRoughness
        rgba = None if plain is None else plain.baseColorFactor
        name = str(entry.name or f"material{primitive.material}")
        image = _image(entry)
        texture = None if image is None else make_texture(*file.image(image.index))
        if texture is not None and _uv_accessor(primitive, image) is None:
            texture = make_texture(texture.name, None)
        colour = [1.0, 1.0, 1.0] if rgba is None else rgba[:3]
        materials = (make_material(name, colour, texture),)
    corners = faces.reshape(-1)
    return Polygons(
        np.full(count, 3, np.int32),
        corners,
        corners if textured else None,
        np.full(count, len(materials) - 1, np.int32),
        materials,
    )


def _check_size(file: GltfFile, frames: int, vertices: int) -> None:
    if frames * vertices * 3.0 > _MOST:
        raise FormatError(f"{file.path}: {frames} frames of {vertices:,} vertices. Cut the clip.")


def _transformed(
    file: GltfFile, part: SourceMesh, world: Float[np.ndarray, "frames 4 4"]
) -> SourceMesh:
    """Transforms a mesh as a whole by its node."""
    _check_size(file, len(world), part.positions.shape[1])
    x = np.broadcast_to(part.positions, (len(world), *part.positions.shape[1:]))
    turned = np.einsum("fab,fvb->fva", world[:, :3, :3], x) + world[:, None, :3, 3]
    part = dataclasses.replace(part, positions=turned.astype(np.float32))
    # A reflection flips the winding (glTF 2.0, 3.7.4).
    return part if np.linalg.det(world[0, :3, :3]) >= 0 else part.reversed()


def _skinned(
    file: GltfFile,
    which: int,
    node: int,
    primitive: object,
    part: SourceMesh,
    world: Float[np.ndarray, "frames nodes 4 4"],
    still: Float[np.ndarray, "nodes 4 4"],
) -> SourceMesh:
    joints, binds = skin_joints(file, which), inverse_binds(file, which)
    weights = _joint_weights(file, primitive, part, len(joints))
    frames, vertices = len(world), part.positions.shape[1]
    _check_size(file, frames, vertices)
    matrices = world[:, joints] @ binds
    out = np.zeros((frames, vertices, 3), np.float32)
    x = np.broadcast_to(part.positions, (frames, vertices, 3))
    for f in range(frames):
        blend = (weights @ matrices[f, :, :3].reshape(len(joints), 12)).reshape(-1, 3, 4)
        out[f] = np.einsum("vab,vb->va", blend[:, :, :3], x[f]) + blend[:, :, 3]
    # The vertices are in the bind pose.
    place = bind_place(file, which, node, still, binds)
    bind = part.positions[0] @ place[:3, :3].T + place[:3, 3]
    return dataclasses.replace(part, positions=out, bind=bind.astype(np.float32))


def _within(which: np.ndarray, count: int) -> bool:
    return bool(which.dtype.kind in "iu" and which.min() >= 0 and which.max() < count)


def _joint_weights(
    file: GltfFile, primitive: object, part: SourceMesh, joints: int
) -> Float[np.ndarray, "vertices joints"]:
    vertices = part.positions.shape[1]
    if vertices * float(joints) > _MOST:
        raise FormatError(f"{file.path}: {joints:,} joints for {vertices:,} vertices. Export anew.")
    out = np.zeros((vertices, joints))
    attributes = primitive.attributes  # pyright: ignore[reportAttributeAccessIssue]
    for k in range(4):
        which = getattr(attributes, f"JOINTS_{k}", None)
        share = getattr(attributes, f"WEIGHTS_{k}", None)
        if which is None or share is None:
            continue
        which, share = np.asarray(file.accessor(which)), np.asarray(file.accessor(share), float)
        fits = which.shape == (vertices, 4) and share.shape == (vertices, 4)
        if not fits or not _within(which, joints):
            raise FormatError(f"{file.path}: skin weights of '{part.name}' don't fit its vertices.")
        np.add.at(out, (np.arange(vertices)[:, None], which.astype(int)), share)
    total = out.sum(axis=1, keepdims=True)
    if not np.isfinite(out).all() or (total <= 0).any():
        raise FormatError(f"{file.path}: vertices of '{part.name}' have no joint weights.")
    return out / total
