"""Animated glTF with a morph target per frame, for short clips in browsers and engines."""

import json
import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Int

from ..errors import FormatError, MissingDependencyError
from ..files import atomic_write
from ..geometry import Texture
from ._animated_mesh import AnimatedMesh, smooth_normals

MAX_FRAMES = 300
"""Largest number of frames: each is stored in full, and viewers hold all of them in memory."""
MAX_BYTES = 400_000_000
"""Largest size of positions and normals [bytes]."""
_VERTEX_BYTES = 24


def write_gltf(path: str | pathlib.Path, meshes: Sequence[AnimatedMesh], fps: float) -> None:
    """Writes meshes as one binary glTF, which most viewers play in a loop.

    Frame 0 is the base mesh; every other frame is a morph target with positions and normals.
    One animation interpolates linearly between them. Each material has its own primitive over
    the shared vertices, and its image is embedded. Vertices are duplicated at texture seams,
    as glTF requires, so the vertex order is kept only for meshes without ``uv``.

    Args:
        path: ``.glb``; written atomically.
        meshes: Meshes to write, all with the same number of frames.
        fps: Frames per second.

    Raises:
        FormatError: There are more than `MAX_FRAMES` frames, or `MAX_BYTES` bytes.
        MissingDependencyError: pygltflib isn't installed.

    References:
        Khronos, glTF 2.0, sections 3.7.2.2 (morph targets) and 3.11 (animations).
    """
    file = _built(path, meshes, fps)
    with atomic_write(path) as part, part.open("wb") as target:
        target.write(b"".join(file.save_to_bytes()))


def gltf_document(
    path: str | pathlib.Path, meshes: Sequence[AnimatedMesh], fps: float
) -> tuple[dict[str, Any], bytes]:
    """The JSON and the buffer of what `write_gltf` writes."""
    file = _built(path, meshes, fps)
    return json.loads(file.gltf_to_json()), file.binary_blob()


def _built(path: str | pathlib.Path, meshes: Sequence[AnimatedMesh], fps: float) -> Any:
    frames = len(meshes[0].positions)
    check_gltf(path, frames, sum(m.positions.shape[1] for m in meshes))
    import pygltflib

    file = _Builder(pygltflib)
    for m in meshes:
        file.add(m)
    file.animate(frames, fps)
    return file.document()


def check_gltf(path: str | pathlib.Path, frames: int | None = None, vertices: int = 0) -> None:
    """Raises the errors of `write_gltf` before there is anything to write.

    Args:
        path: File name for the error message.
        frames: Number of frames, if known.
        vertices: Number of vertices, as far as it is known.
    """
    size = _VERTEX_BYTES * vertices * (frames or 0)
    if size > MAX_BYTES:
        raise FormatError(
            f"{path}: {frames} frames of {vertices} vertices take {size / 1e6:.0f} MB, too much"
            f" for glTF (at most {MAX_BYTES / 1e6:.0f}): write .usdc or .pc2, or fewer frames"
            " (--frames)."
        )
    if frames is not None and frames > MAX_FRAMES:
        raise FormatError(
            f"{path}: {frames} frames are too many for glTF (at most {MAX_FRAMES}): write"
            " .usdc or .pc2, or fewer frames (--frames)."
        )
    try:
        import pygltflib  # noqa: F401
    except ImportError as error:
        raise MissingDependencyError(
            "Writing glTF needs pygltflib: pip install 'physxnet-jax[gltf]'."
        ) from error


class _Builder:
    """Builds a glTF document and its single buffer."""

    def __init__(self, library) -> None:
        self.lib = library
        self.gltf = library.GLTF2(
            asset=library.Asset(version="2.0", generator="physxnet_jax"),
            scene=0,
            scenes=[library.Scene(nodes=[])],
        )
        self.blob = bytearray()
        self.images: dict[Texture, int] = {}

    def add(self, m: AnimatedMesh) -> None:
        lib, gltf = self.lib, self.gltf
        rows, faces, uv = _split_at_seams(m)
        x = m.positions[:, rows].astype(np.float32)
        n = smooth_normals(m.positions, m.faces)[:, rows]
        attributes = {"POSITION": self.store(x[0], "VEC3"), "NORMAL": self.store(n[0], "VEC3")}
        if uv is not None:
            # In glTF, texture coordinates start at the top of the image.
            attributes["TEXCOORD_0"] = self.store(uv * [1, -1] + [0, 1], "VEC2")
        targets = [
            {
                "POSITION": self.store(x[k] - x[0], "VEC3"),
                "NORMAL": self.store(n[k] - n[0], "VEC3"),
            }
            for k in range(1, len(x))
        ]
        primitives = []
        for look in m.looks:
            image = None if look.texture is None else self.image(look.texture)
            gltf.materials.append(
                lib.Material(
                    name=look.name,
                    doubleSided=True,
                    pbrMetallicRoughness=lib.PbrMetallicRoughness(
                        baseColorFactor=[*map(float, look.colour), 1.0],
                        baseColorTexture=None if image is None else lib.TextureInfo(index=image),
                        metallicFactor=0.0,
                        roughnessFactor=0.8,
                    ),
                )
            )
            primitives.append(
                lib.Primitive(
                    attributes=lib.Attributes(**attributes),
                    indices=self.store(
                        faces[look.faces].reshape(-1).astype(np.uint32), "SCALAR", index=True
                    ),
                    material=len(gltf.materials) - 1,
                    targets=targets,
                )
            )
        gltf.meshes.append(
            lib.Mesh(name=m.name, primitives=primitives, weights=[0.0] * len(targets))
        )
        gltf.nodes.append(lib.Node(name=m.name, mesh=len(gltf.meshes) - 1))
        gltf.scenes[0].nodes.append(len(gltf.nodes) - 1)

    def image(self, texture: Texture) -> int:
        """Stores an image in the buffer and returns the index of its texture."""
        lib, gltf = self.lib, self.gltf
        if texture not in self.images:
            blob = texture.data or b""
            gltf.bufferViews.append(
                lib.BufferView(buffer=0, byteOffset=len(self.blob), byteLength=len(blob))
            )
            # The next view must start at a multiple of four bytes.
            self.blob += blob + bytes(-len(blob) % 4)
            kind = "image/png" if texture.ending == ".png" else "image/jpeg"
            view = len(gltf.bufferViews) - 1
            gltf.images.append(lib.Image(name=texture.name, mimeType=kind, bufferView=view))
            if not gltf.samplers:
                gltf.samplers.append(lib.Sampler(wrapS=lib.REPEAT, wrapT=lib.REPEAT))
            gltf.textures.append(lib.Texture(source=len(gltf.images) - 1, sampler=0))
            self.images[texture] = len(gltf.textures) - 1
        return self.images[texture]

    def animate(self, frames: int, fps: float) -> None:
        if frames < 2:
            return
        lib = self.lib
        times = self.store((np.arange(frames) / fps).astype(np.float32), "SCALAR")
        weights = self.store(np.eye(frames, dtype=np.float32)[:, 1:].reshape(-1), "SCALAR")
        self.gltf.animations.append(
            lib.Animation(
                name="clip",
                samplers=[
                    lib.AnimationSampler(input=times, output=weights, interpolation="LINEAR")
                ],
                channels=[
                    lib.AnimationChannel(
                        sampler=0, target=lib.AnimationChannelTarget(node=k, path="weights")
                    )
                    for k in range(len(self.gltf.nodes))
                ],
            )
        )

    def store(self, values: np.ndarray, kind: str, *, index: bool = False) -> int:
        """Stores an array in the buffer and returns the index of its accessor."""
        lib, gltf = self.lib, self.gltf
        values = np.ascontiguousarray(values, np.uint32 if index else np.float32)
        blob = values.tobytes()
        gltf.bufferViews.append(
            lib.BufferView(buffer=0, byteOffset=len(self.blob), byteLength=len(blob))
        )
        self.blob += blob
        rows = values.reshape(len(values), -1)
        gltf.accessors.append(
            lib.Accessor(
                bufferView=len(gltf.bufferViews) - 1,
                componentType=lib.UNSIGNED_INT if index else lib.FLOAT,
                count=len(values),
                type=kind,
                min=rows.min(axis=0).tolist(),
                max=rows.max(axis=0).tolist(),
            )
        )
        return len(gltf.accessors) - 1

    def document(self):
        self.gltf.buffers.append(self.lib.Buffer(byteLength=len(self.blob)))
        self.gltf.set_binary_blob(bytes(self.blob))
        return self.gltf


def _split_at_seams(
    m: AnimatedMesh,
) -> tuple[Int[np.ndarray, " points"], Int[np.ndarray, "faces 3"], np.ndarray | None]:
    """Splits vertices at texture seams: original vertices, triangles, texture coordinates."""
    if m.uv is None or m.uv_faces is None:
        return np.arange(m.positions.shape[1]), m.faces, None
    corners = np.stack([m.faces.reshape(-1), m.uv_faces.reshape(-1)], axis=1)
    pairs, index = np.unique(corners, axis=0, return_inverse=True)
    return pairs[:, 0], index.reshape(-1, 3), m.uv[pairs[:, 1]]
