"""Bounds-checked access to glTF files: accessors, nodes and animations."""

import base64
import binascii
import pathlib
import urllib.parse
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from ..errors import MotionError
from ..files import add_inputs, is_file
from ._frame_rate import nominal_rate
from ._gltf_document import MAX_BYTES, declared_tree, parse_gltf
from ._gltf_track import track_at

_MAX_NODES = 20_000
_MAX_KEYS = 100_000_000
# Largest sparse accessor without stored values, which are zero.
_MAX_SPARSE = 10_000_000
# Frames times nodes: each takes a matrix.
_MAX_NODE_FRAMES = 1.2e7
_DTYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
_LENGTHS = {"translation": 3, "rotation": 4, "scale": 3}
_MAX_COORDINATE = 1e12
_Track = tuple[np.ndarray, np.ndarray, str]
# VRM extensions that map nodes to bones: of models, of animations, and of version 0.
_HUMANOID = ("VRMC_vrm", "VRMC_vrm_animation", "VRM")

GLTF_FORMATS = (".glb", ".gltf", ".vrm", ".vrma")
"""Extensions of glTF files, including VRM models and animations."""


class GltfFile:
    """A glTF 2.0 document and its buffers.

    Attributes:
        document: The document as pygltflib parses it.
        path: The file, for error messages.
        parents: Parent of every node, -1 for roots.
        order: Nodes with parents before children.

    Raises:
        MotionError: The file isn't glTF 2.0 or is truncated, its nodes form a cycle, a
            reference is invalid, or a buffer is outside the file's folder. Nothing is
            downloaded.
        MissingDependencyError: pygltflib isn't installed.

    References:
        Khronos, glTF 2.0, sections 3.5 (nodes), 3.6 (buffers and accessors) and
        3.11 (animations); VRM Consortium, VRMC_vrm-1.0, humanoid.
    """

    def __init__(self, path: str | pathlib.Path) -> None:
        self.path = pathlib.Path(path)
        self._buffers: dict[int, bytes] = {}
        self._keys: dict[int, dict[tuple[int, str], _Track]] = {}
        self._images: dict[int, tuple[str, bytes | None]] = {}
        self.document = parse_gltf(self.path)
        nodes = self.document.nodes
        if not nodes or len(nodes) > _MAX_NODES:
            raise self.broken(f"{len(nodes or ())} nodes")
        self.parents = np.full(len(nodes), -1)
        for n, node in enumerate(nodes):
            for child in node.children or ():
                child = self.index(child, nodes, "node")
                if self.parents[child] >= 0 or child == n:
                    raise self.broken(f"node {child} has two parents")
                self.parents[child] = n
        self.order = self._topological_order()

    def broken(self, problem: str) -> MotionError:
        """The error to raise for a damaged file."""
        return MotionError.at(self.path, None, f"damaged glTF: {problem}", "Export it again")

    def index(self, value: object, of: Any, what: str) -> int:
        """Checks a reference and returns it."""
        if type(value) is not int or not 0 <= value < len(of or ()):
            raise self.broken(f"{what} {value} doesn't exist")
        return value

    def bones(self) -> dict[int, str]:
        """Maps nodes to the humanoid bones that VRM extensions assign to them."""
        entry = self.document.extensions or {}
        for key in _HUMANOID:
            humanoid = entry.get(key, {}).get("humanoid", {}).get("humanBones")
            if not humanoid:
                continue
            pairs = (
                [(name, bone["node"]) for name, bone in humanoid.items()]
                if isinstance(humanoid, dict)
                else [(bone["bone"], bone["node"]) for bone in humanoid]
            )
            return {self.index(n, self.document.nodes, "node"): str(b) for b, n in pairs}
        return {}

    def accessor(self, which: object) -> np.ndarray:
        """Values of an accessor, shape [count] or [count, width].

        Normalised integers become floats.
        """
        document = self.document
        a = document.accessors[self.index(which, document.accessors, "accessor")]
        dtype, width = _DTYPES.get(a.componentType), _WIDTHS.get(a.type)
        if dtype is None or width is None or type(a.count) is not int or a.count < 1:
            raise self.broken(f"accessor {which} of type {a.type}, {a.componentType}, {a.count}")
        if a.bufferView is None:
            if a.sparse is None and "KHR_draco_mesh_compression" in self._extensions():
                raise self._compressed("KHR_draco_mesh_compression")
            if a.sparse is None or a.count * width > _MAX_SPARSE:
                raise self.broken(f"accessor {which} has no values")
            rows = np.zeros((a.count, width), dtype)
        else:
            rows = self._rows(a.bufferView, a.byteOffset, dtype, a.count, width).copy()
        if a.sparse is not None:
            self._scatter(which, a.sparse, rows)
        values = rows[:, 0] if width == 1 else rows
        if a.normalized:
            return np.maximum(values / np.iinfo(dtype).max, -1.0)
        return values

    def _rows(
        self, which: object, offset: int | None, dtype: str, count: int, width: int
    ) -> np.ndarray:
        """Rows of a buffer view, without a copy."""
        views = self.document.bufferViews
        view = views[self.index(which, views, "view")]
        size = np.dtype(dtype).itemsize * width
        for compression in view.extensions or ():
            if "meshopt_compression" in compression:
                raise self._compressed(compression)
        step = view.byteStride or size
        start = offset or 0
        end = start + step * (count - 1) + size
        if min(start, step - size) < 0 or end > (view.byteLength or 0):
            raise self.broken(f"an accessor reaches past view {which}")
        first = (view.byteOffset or 0) + start
        blob = self.buffer(view.buffer)
        if first < 0 or first - start + (view.byteLength or 0) > len(blob):
            raise self.broken(f"view {which} reaches past its buffer")
        return np.ndarray(
            (count, width), dtype, buffer=blob, offset=first, strides=(step, size // width)
        )

    def _extensions(self) -> tuple[str, ...]:
        return (*(self.document.extensionsRequired or ()), *(self.document.extensionsUsed or ()))

    def _compressed(self, extension: str) -> MotionError:
        return MotionError.at(
            self.path,
            None,
            f"its meshes are compressed ({extension}), which isn't supported; a motion is read",
            "Decompress it: npx @gltf-transform/cli copy IN OUT",
        )

    def _scatter(self, which: object, sparse: Any, rows: np.ndarray) -> None:
        """Writes the values of a sparse accessor into its rows (glTF 2.0, 3.6.2.3)."""
        index, values = sparse.indices, sparse.values
        kind = _DTYPES.get(index.componentType)
        if type(sparse.count) is not int or not 1 <= sparse.count <= len(rows) or kind is None:
            raise self.broken(f"accessor {which} is sparse in {sparse.count} places")
        at = self._rows(index.bufferView, index.byteOffset, kind, sparse.count, 1)[:, 0]
        if at.dtype.kind not in "iu" or int(at.min()) < 0 or int(at.max()) >= len(rows):
            raise self.broken(f"accessor {which} has sparse indices out of range")
        rows[at.astype(np.int64)] = self._rows(
            values.bufferView, values.byteOffset, rows.dtype.str, sparse.count, rows.shape[1]
        )

    def local(self, node: int) -> dict[str, Float[np.ndarray, " n"]]:
        """Translation, rotation (xyzw) and scale of a node."""
        entry = self.document.nodes[node]
        out = {
            "translation": np.array(entry.translation or (0.0, 0.0, 0.0), float),
            "rotation": np.array(entry.rotation or (0.0, 0.0, 0.0, 1.0), float),
            "scale": np.array(entry.scale or (1.0, 1.0, 1.0), float),
        }
        if entry.matrix is not None:
            m = np.array(entry.matrix, float)
            if m.shape != (16,) or not (np.abs(m) < _MAX_COORDINATE).all():
                raise self.broken(f"the matrix of node {node}")
            out = self._split(m.reshape(4, 4).T, node)
        if any(
            out[k].shape != (_LENGTHS[k],) or not (np.abs(out[k]) < _MAX_COORDINATE).all()
            for k in out
        ) or not np.linalg.norm(out["rotation"]):
            raise self.broken(f"the transform of node {node}")
        return out

    def world(
        self, times: Float[np.ndarray, " frames"] | None = None, animation: int | None = None
    ) -> Float[np.ndarray, "frames nodes 4 4"]:
        """World matrices of all nodes.

        Args:
            times: Times of the animation [s]; the static transforms of nodes if omitted.
            animation: Index of the animation; the longest by default.
        """
        tracks = {} if times is None else self._tracks(animation)
        at = np.zeros(1) if times is None else times
        out = np.zeros((len(at), len(self.parents), 4, 4))
        for n in self.order:
            place = {k: np.tile(v, (len(at), 1)) for k, v in self.local(n).items()}
            for kind in (k for k in _LENGTHS if (n, k) in tracks):
                keys, values, mode = tracks[n, kind]
                place[kind] = track_at(keys, values, mode, at, kind)
            self._set_world(out, n, Rotation.from_quat(place["rotation"]).as_matrix(), place)
        return out

    def posed(
        self,
        turns: Mapping[int, Float[np.ndarray, "frames 3 3"]],
        rest: Float[np.ndarray, "nodes 4 4"] | None = None,
    ) -> Float[np.ndarray, "frames nodes 4 4"]:
        """World matrices of all nodes, with the rotations of some replaced.

        Args:
            turns: World rotations by node, without scaling.
            rest: World matrices of the pose that the others keep relative to their parents;
                by default the static node transforms.
        """
        frames = len(next(iter(turns.values())))
        out = np.zeros((frames, len(self.parents), 4, 4))
        for n in self.order:
            place = self.local(n) if rest is None else self._between(rest, n)
            turn = Rotation.from_quat(place["rotation"]).as_matrix()[None]
            if n in turns:
                above = out[:, self.parents[n], :3, :3] if self.parents[n] >= 0 else np.eye(3)[None]
                turn = np.swapaxes(nearest_turns(above), 1, 2) @ turns[n]
            self._set_world(out, n, turn, {k: v[None] for k, v in place.items()})
        return out

    def _between(
        self, world: Float[np.ndarray, "nodes 4 4"], n: int
    ) -> dict[str, Float[np.ndarray, " n"]]:
        """Translation, rotation and scale of a node relative to its parent."""
        parent = int(self.parents[n])
        m = world[n] if parent < 0 else np.linalg.pinv(world[parent]) @ world[n]
        return self._split(m, n)

    def _split(self, m: Float[np.ndarray, "4 4"], node: int) -> dict[str, Float[np.ndarray, " n"]]:
        scale = np.linalg.norm(m[:3, :3], axis=0)
        if (scale < 1e-12).any():
            raise self.broken(f"node {node} is scaled to nothing")
        # A reflection isn't a rotation: its sign goes to the scale.
        scale = scale if np.linalg.det(m[:3, :3]) > 0 else -scale
        turn = Rotation.from_matrix(m[:3, :3] / scale).as_quat()
        return {"translation": m[:3, 3], "rotation": turn, "scale": scale}

    def _set_world(
        self,
        out: Float[np.ndarray, "frames nodes 4 4"],
        n: int,
        turn: Float[np.ndarray, "_ 3 3"],
        place: dict[str, Float[np.ndarray, "_ n"]],
    ) -> None:
        m = np.zeros((len(out), 4, 4))
        m[:, :3, :3] = turn * place["scale"][:, None]
        m[:, :3, 3] = place["translation"]
        m[:, 3, 3] = 1.0
        parent = self.parents[n]
        with np.errstate(all="ignore"):
            out[:, n] = m if parent < 0 else out[:, parent] @ m
        if not (np.abs(out[:, n]) < _MAX_COORDINATE).all():
            raise self.broken(f"node {n} is too far away")

    def frame_times(
        self, animation: int | None = None, *, rate: float | None = None
    ) -> tuple[Float[np.ndarray, " frames"], float]:
        """Times of an animation's frames [s], and their rate.

        Args:
            animation: Index of the animation; the longest by default.
            rate: Frames per second. If omitted, the rate of the densest keys; morph targets
                are then ignored.
        """
        keys = [
            times
            for (_, kind), (times, _, _) in self._tracks(animation).items()
            if len(times) > 1 and (kind in _LENGTHS or rate is not None)
        ]
        if not keys:
            return self._single_time(animation, rate)
        start, end = min(float(k[0]) for k in keys), max(float(k[-1]) for k in keys)
        if rate is None:
            step = min(float(np.median(np.diff(k))) for k in keys)
            rate = min(max(1.0 / max(step, 1e-6), 10.0), 240.0)
            rate = nominal_rate(rate)
        if (end - start) * rate * len(self.parents) > _MAX_NODE_FRAMES:
            raise self.broken(f"an animation of {end - start:.0f} seconds")
        return start + np.arange(int((end - start) * rate + 1e-3) + 1) / rate, rate

    def _single_time(
        self, animation: int | None, rate: float | None
    ) -> tuple[Float[np.ndarray, " frames"], float]:
        """The time of a single key, or time 0 for a mesh that isn't animated."""
        keys = [
            times
            for (_, kind), (times, _, _) in self._tracks(animation).items()
            if len(times) and (kind in _LENGTHS or rate is not None)
        ]
        if not keys and rate is None:
            raise MotionError.at(
                self.path, None, "no animation of nodes", "Export it with its animation"
            )
        return np.array([float(keys[0][0]) if keys else 0.0]), rate or 30.0

    def animation(self, name: str | None = None) -> int:
        """Index of an animation by its name, or of the longest one.

        Raises:
            MotionError: No animation has this name.
        """
        names = self.animation_names()
        if name is None:
            return max(range(len(names)), key=self._duration, default=0)
        if name not in names:
            found = ", ".join(names)[:300] or "none"
            raise MotionError.at(
                self.path, None, f"no animation '{name}'; there are {found}", "Choose one of them"
            )
        return names.index(name)

    def animation_names(self) -> list[str]:
        """Names of the animations, in the file's order."""
        return [str(a.name or k) for k, a in enumerate(self.document.animations or ())]

    def _duration(self, animation: int) -> float:
        keys = [times for times, _, _ in self._tracks(animation).values() if len(times)]
        return max((float(k[-1]) for k in keys), default=0.0) - min(
            (float(k[0]) for k in keys), default=0.0
        )

    def _tracks(self, animation: int | None) -> dict[tuple[int, str], _Track]:
        """Times, values and interpolation mode of an animation's tracks, cached."""
        if animation is None:
            animation = self.animation()
        if animation not in self._keys:
            self._keys[animation] = self._read_tracks(animation)
        return self._keys[animation]

    def _read_tracks(self, animation: int) -> dict[tuple[int, str], _Track]:
        document = self.document
        if not document.animations:
            return {}
        a = document.animations[self.index(animation, document.animations, "animation")]
        out = {}
        numbers = 0
        for channel in a.channels:
            kind = channel.target.path
            if channel.target.node is None or kind not in (*_LENGTHS, "weights"):
                continue
            node = self.index(channel.target.node, document.nodes, "node")
            sampler = a.samplers[self.index(channel.sampler, a.samplers, "sampler")]
            times = np.asarray(self.accessor(sampler.input), float)
            values = np.asarray(self.accessor(sampler.output), float)
            mode = sampler.interpolation or "LINEAR"
            rows = 3 * len(times) if mode == "CUBICSPLINE" else len(times)
            if kind == "weights" and values.ndim == 1 and rows and len(values) % rows == 0:
                # Each key has one value per morph target.
                values = values.reshape(rows, -1)
            if (
                times.ndim != 1
                or values.ndim != 2
                or values.shape != (rows, _LENGTHS.get(kind, values.shape[1]))
                or not (
                    (np.abs(times) < _MAX_COORDINATE).all()
                    and (np.abs(values) < _MAX_COORDINATE).all()
                )
                or (np.diff(times) < 0).any()
            ):
                raise self.broken(f"the keys of node {node}, {kind}")
            # Channels may share accessors, so the file's size doesn't limit them.
            numbers += times.size + values.size
            if numbers > _MAX_KEYS:
                raise self.broken("too many keys")
            out[node, kind] = (times, values, mode)
        return out

    def morph_weights(
        self, node: int, times: Float[np.ndarray, " frames"] | None, animation: int | None = None
    ) -> Float[np.ndarray, "frames targets"] | None:
        """Weights of a node's morph targets over time; None if it has none.

        Weights that aren't animated have a single frame: the node's, else those of its mesh.
        """
        track = None if times is None else self._tracks(animation).get((node, "weights"))
        if track is None or times is None:
            return self._static_weights(node)
        keys, values, mode = track
        return track_at(keys, values, mode, times, "weights")

    def _static_weights(self, node: int) -> Float[np.ndarray, "1 targets"] | None:
        entry, meshes = self.document.nodes[node], self.document.meshes
        weights = entry.weights
        if not weights and entry.mesh is not None:
            weights = meshes[self.index(entry.mesh, meshes, "mesh")].weights
        if not weights:
            return None
        out = np.array(weights, float)
        if out.ndim != 1 or not (np.abs(out) < _MAX_COORDINATE).all():
            raise self.broken(f"the weights of node {node}")
        return out[None]

    def image(self, texture: object) -> tuple[str, bytes | None]:
        """Name and bytes of a texture's image; the bytes are None if its file is missing."""
        textures = self.document.textures
        source = textures[self.index(texture, textures, "texture")].source
        if source is None:
            return f"texture{texture}", None
        if source not in self._images:
            self._images[source] = self._read_image(source)
        return self._images[source]

    def image_bytes(self, which: int) -> bytes | None:
        """Bytes of an image; None if its file is missing."""
        return self._read_image(which)[1]

    def declared(self) -> dict[str, Any]:
        """The file's JSON as dictionaries."""
        return declared_tree(self.path)

    def _read_image(self, source: object) -> tuple[str, bytes | None]:
        document = self.document
        entry = document.images[self.index(source, document.images, "image")]
        name = str(entry.name or entry.uri or f"image{source}")[:200]
        if entry.bufferView is not None:
            views = document.bufferViews
            view = views[self.index(entry.bufferView, views, "view")]
            start, size = view.byteOffset or 0, view.byteLength or 0
            blob = self.buffer(view.buffer)
            if min(start, size) < 0 or start + size > len(blob):
                raise self.broken(f"view {entry.bufferView} reaches past its buffer")
            return name, blob[start : start + size]
        if entry.uri is None:
            return name, None
        if entry.uri.startswith("data:"):
            return name if entry.name else f"image{source}", self._decoded(entry.uri, "image")
        try:
            return name, self._read_relative(entry.uri)
        # A missing image doesn't invalidate the mesh.
        except MotionError:
            return name, None

    def _decoded(self, uri: str, what: str) -> bytes:
        try:
            return base64.b64decode(uri.partition(",")[2], validate=True)
        except binascii.Error as error:
            raise self.broken(f"{what} isn't base64") from error

    def buffer(self, which: object) -> bytes:
        """Bytes of a buffer."""
        n = self.index(which, self.document.buffers, "buffer")
        if n not in self._buffers:
            uri = self.document.buffers[n].uri
            if uri is None:
                self._buffers[n] = self.document.binary_blob() or b""
            elif uri.startswith("data:"):
                self._buffers[n] = self._decoded(uri, f"buffer {n}")
            else:
                self._buffers[n] = self._read_relative(uri)
        return self._buffers[n]

    def _read_relative(self, uri: str) -> bytes:
        uri = urllib.parse.unquote(uri)
        folder = self.path.parent.resolve()
        file = (folder / uri).resolve()
        if ":" in uri or not file.is_relative_to(folder):
            raise MotionError.at(
                self.path,
                None,
                f"its buffer '{uri[:60]}' is outside its folder",
                "Put it beside the file, or export a .glb; other files aren't opened",
            )
        if not is_file(file) or file.stat().st_size > MAX_BYTES:
            raise MotionError.at(
                self.path,
                None,
                f"its buffer '{uri[:60]}' is missing or over 1 GB",
                "Put it beside the file",
            )
        add_inputs(file)
        return file.read_bytes()

    def _topological_order(self) -> list[int]:
        depth = np.full(len(self.parents), -1)
        for n in range(len(self.parents)):
            chain = []
            while n >= 0 and depth[n] < 0:
                if len(chain) > len(self.parents):
                    raise self.broken("its nodes form a cycle")
                chain.append(n)
                n = int(self.parents[n])
            base = depth[n] if n >= 0 else -1
            for k, m in enumerate(reversed(chain)):
                depth[m] = base + 1 + k
        return np.argsort(depth, kind="stable").tolist()


def nearest_turns(
    matrices: Float[np.ndarray, "*rows 3 3"],
) -> Float[np.ndarray, "*rows 3 3"]:
    """Nearest rotations to matrices that may scale.

    Raises:
        ValueError: A matrix is singular.
    """
    u, scales, v = np.linalg.svd(matrices)
    if (scales[..., 2] < 1e-9).any():
        raise ValueError("a joint is scaled to nothing")
    flip = np.linalg.det(u @ v) < 0
    u[..., 2] = np.where(flip[..., None], -u[..., 2], u[..., 2])
    return u @ v
