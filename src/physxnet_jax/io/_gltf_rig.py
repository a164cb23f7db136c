"""Adds garments and an animation to the glTF or VRM file of a rigged person."""

import json
import pathlib
import struct
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from ..errors import FormatError
from ..files import atomic_write
from ._animated_mesh import AnimatedMesh
from ._gltf import gltf_document
from ._gltf_file import GltfFile, nearest_turns

_JSON, _BINARY = 0x4E4F534A, 0x004E4942
_FLOAT = 5126


def write_dressed_rig(
    path: str | pathlib.Path,
    source: str | pathlib.Path,
    world: Float[np.ndarray, "frames nodes 4 4"],
    joints: Sequence[int],
    garments: Sequence[AnimatedMesh],
    fps: float,
    *,
    unit: float = 1.0,
    name: str = "motion",
) -> None:
    """Writes a copy of a rigged person's file with one more animation, and garments.

    All that the file has is kept as it is: skins, materials, images, morph targets,
    animations and extensions, those of VRM among them. Joints get keys of rotation, and of
    translation where it changes; garments are morph targets under the same animation.

    Args:
        path: The ``.glb`` to write, atomically.
        source: The ``.glb``, ``.gltf`` or ``.vrm`` file of the person.
        world: World matrices of all nodes in every frame, in the file's unit.
        joints: The nodes that move.
        garments: Meshes with as many frames [m].
        fps: Frames per second.
        unit: The file's unit [m].
        name: Name of the animation.

    Raises:
        FormatError: Too many frames for morph targets.
        MotionError: The source is damaged.

    References:
        Khronos, glTF 2.0, sections 3.11 (animations) and 4.4 (GLB).
    """
    file = GltfFile(source)
    tree, blob = _embedded(file)
    scene = tree.setdefault("scenes", [{"nodes": []}])[tree.setdefault("scene", 0)]
    tracks = _Tracks(tree, blob)
    for node, kind, values in _joint_tracks(file, world, joints):
        tracks.add(node, kind, values, fps)
    first, moving = len(tree["nodes"]), []
    if garments:
        moving = _append(tree, blob, *gltf_document(path, garments, fps))
    for node in tree["nodes"][first:]:
        node["scale"] = [1.0 / unit] * 3
    scene.setdefault("nodes", []).extend(range(first, len(tree["nodes"])))
    samplers, channels = tracks.samplers, tracks.channels
    for animation in moving:
        base = len(samplers)
        samplers += animation["samplers"]
        channels += [c | {"sampler": c["sampler"] + base} for c in animation["channels"]]
    if channels:
        entry = {"name": name, "samplers": samplers, "channels": channels}
        tree.setdefault("animations", []).append(entry)
    tree["buffers"] = [{"byteLength": len(blob)}]
    text = json.dumps(tree, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    blob += bytes(-len(blob) % 4)
    size = 12 + 8 + len(text) + 8 + len(blob)
    with atomic_write(path) as part, part.open("wb") as target:
        target.write(b"glTF" + struct.pack("<2I", 2, size))
        target.write(struct.pack("<2I", len(text), _JSON) + text)
        target.write(struct.pack("<2I", len(blob), _BINARY) + blob)


def _embedded(file: GltfFile) -> tuple[dict[str, Any], bytearray]:
    """A file's JSON, and all of its buffers and images as one buffer."""
    tree = file.declared()
    blob = bytearray()
    starts = []
    for k in range(len(tree.get("buffers", ()))):
        starts.append(len(blob))
        part = file.buffer(k)
        blob += part + bytes(-len(part) % 4)
    for view in tree.get("bufferViews", ()):
        view["byteOffset"] = view.get("byteOffset", 0) + starts[view.get("buffer", 0)]
        view["buffer"] = 0
    for k, image in enumerate(tree.get("images", ())):
        if "uri" not in image or image["uri"].startswith("data:"):
            continue
        data = file.image_bytes(k)
        if data is None:
            raise FormatError(
                f"{file.path}: its image '{image['uri'][:80]}' is missing. Put it beside the file."
            )
        ending = pathlib.PurePath(image.pop("uri")).suffix.lower()
        image.setdefault("mimeType", "image/png" if ending == ".png" else "image/jpeg")
        image["bufferView"] = _add_view(tree, blob, data)
    return tree, blob


def _add_view(tree: dict[str, Any], blob: bytearray, data: bytes) -> int:
    views = tree.setdefault("bufferViews", [])
    views.append({"buffer": 0, "byteOffset": len(blob), "byteLength": len(data)})
    blob += data + bytes(-len(data) % 4)
    return len(views) - 1


class _Tracks:
    """Animation samplers and channels over shared times."""

    def __init__(self, tree: dict[str, Any], blob: bytearray) -> None:
        self.tree, self.blob = tree, blob
        self.samplers: list[dict[str, Any]] = []
        self.channels: list[dict[str, Any]] = []
        self.times: int | None = None

    def add(self, node: int, kind: str, values: np.ndarray, fps: float) -> None:
        if self.times is None:
            self.times = self._store(np.arange(len(values), dtype=np.float32) / np.float32(fps))
        self.samplers.append(
            {"input": self.times, "output": self._store(values), "interpolation": "LINEAR"}
        )
        target = {"node": node, "path": kind}
        self.channels.append({"sampler": len(self.samplers) - 1, "target": target})

    def _store(self, values: np.ndarray) -> int:
        values = np.ascontiguousarray(values, np.float32)
        rows = values.reshape(len(values), -1)
        accessors = self.tree.setdefault("accessors", [])
        accessors.append(
            {
                "bufferView": _add_view(self.tree, self.blob, values.tobytes()),
                "componentType": _FLOAT,
                "count": len(values),
                "type": {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[rows.shape[1]],
                "min": rows.min(axis=0).tolist(),
                "max": rows.max(axis=0).tolist(),
            }
        )
        return len(accessors) - 1


def _joint_tracks(
    file: GltfFile, world: Float[np.ndarray, "frames nodes 4 4"], joints: Sequence[int]
) -> list[tuple[int, str, np.ndarray]]:
    """Local rotations of the joints, and translations where they differ from the file's."""
    moving = _with_nodes_between(file, joints)
    still = file.world()[0]
    out = []
    for n in (n for n in file.order if n in moving):
        parent = int(file.parents[n])
        if parent < 0:
            local = world[:, n]
        else:
            above = world[:, parent] if parent in moving else still[None, parent]
            local = np.linalg.pinv(above) @ world[:, n]
        turns = Rotation.from_matrix(nearest_turns(local[:, :3, :3])).as_quat()
        # Interpolation takes the shorter way between neighbours of one sign.
        for k in range(1, len(turns)):
            if turns[k] @ turns[k - 1] < 0:
                turns[k] = -turns[k]
        out.append((n, "rotation", turns))
        own = file.local(n)["translation"]
        size = max(float(np.abs(still[list(moving), :3, 3]).max(initial=0.0)), 1e-6)
        if np.abs(local[:, :3, 3] - own).max() > 1e-5 * size:
            out.append((n, "translation", local[:, :3, 3]))
    return out


def _with_nodes_between(file: GltfFile, joints: Sequence[int]) -> set[int]:
    moving = set(joints)
    for joint in joints:
        chain, n = [], int(file.parents[joint])
        while n >= 0 and n not in moving:
            chain.append(n)
            n = int(file.parents[n])
        moving |= set(chain) if n >= 0 else set()
    return moving


def _append(
    tree: dict[str, Any], blob: bytearray, other: dict[str, Any], other_blob: bytes
) -> list[dict[str, Any]]:
    """Appends a document's content, and returns its animations with the new indices."""
    kinds = ("bufferViews", "accessors", "images", "samplers", "textures", "materials", "meshes")
    at = {k: len(tree.setdefault(k, [])) for k in (*kinds, "nodes")}
    offset = len(blob)
    blob += other_blob
    shifted = {
        "bufferView": at["bufferViews"],
        "indices": at["accessors"],
        "input": at["accessors"],
        "output": at["accessors"],
        "source": at["images"],
        "material": at["materials"],
        "mesh": at["meshes"],
        "node": at["nodes"],
    }

    def moved(value: Any, key: str = "", inside: str = "") -> Any:
        if isinstance(value, list):
            return [moved(v, key, inside) for v in value]
        if isinstance(value, dict):
            if key in ("attributes", "targets"):
                return {k: v + at["accessors"] for k, v in value.items() if v is not None}
            return {k: moved(v, k, key) for k, v in value.items()}
        if isinstance(value, int) and key in shifted:
            return value + shifted[key]
        if key == "sampler" and inside == "textures":
            return value + at["samplers"]
        if key == "index" and inside == "baseColorTexture":
            return value + at["textures"]
        return value

    for kind in (*kinds, "nodes"):
        for entry in other.get(kind) or ():
            entry = moved(entry, kind)
            if kind == "bufferViews":
                entry["byteOffset"] = entry.get("byteOffset", 0) + offset
            tree[kind].append(entry)
        if not tree[kind]:
            del tree[kind]
    return [moved(a, "animations") for a in other.get("animations") or ()]
