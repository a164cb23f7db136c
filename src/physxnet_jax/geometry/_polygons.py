"""Faces as a file has them, before they were cut into triangles: for writing them again."""

import dataclasses
import functools
import hashlib
from collections.abc import Sequence

import numpy as np
from jaxtyping import Int

from ..errors import MeshError


@dataclasses.dataclass(frozen=True)
class Texture:
    """An image that colours faces by their texture coordinates.

    Attributes:
        name: What its file is called, without folders.
        data: The file as it is, a PNG or a JPEG; None if it wasn't there or is neither.
    """

    name: str
    data: bytes | None = dataclasses.field(default=None, repr=False)

    @property
    def ending(self) -> str:
        """What its kind of file ends in: ``.png`` or ``.jpg``."""
        return ".png" if self.data is None else _kind(self.data) or ".png"


def make_texture(name: str, data: bytes | None) -> Texture:
    """A texture as a file tells it; what is neither PNG nor JPEG is only named.

    Args:
        name: What its file is called; folders are left out.
        data: The file; None if it can't be had.
    """
    name = name.replace("\\", "/").rpartition("/")[2]
    return Texture(name, data if data is not None and _kind(data) else None)


def _kind(data: bytes) -> str | None:
    if data.startswith(b"\x89PNG\r\n\x1a\n"):
        return ".png"
    return ".jpg" if data.startswith(b"\xff\xd8\xff") else None


@dataclasses.dataclass(frozen=True)
class Material:
    """What a file calls the look of some faces.

    Attributes:
        name: Its name there.
        colour: Linear RGB in [0, 1], by which a texture is multiplied; None if the file
            doesn't say.
        texture: Its base colour as an image; None without one.
    """

    name: str
    colour: tuple[float, float, float] | None = None
    texture: Texture | None = None


def make_material(name: str, colour: object = None, texture: Texture | None = None) -> Material:
    """A material as a file tells it; a colour that isn't three finite numbers is none.

    Args:
        name: Its name.
        colour: Linear RGB, brought into [0, 1].
        texture: Its image.
    """
    rgb = np.zeros(0) if colour is None else np.asarray(colour)
    if rgb.shape != (3,) or rgb.dtype.kind not in "fiu" or not np.isfinite(rgb).all():
        return Material(name, texture=texture)
    r, g, b = np.clip(rgb.astype(float), 0.0, 1.0).tolist()
    return Material(name, (r, g, b), texture)


@dataclasses.dataclass(frozen=True, eq=False)
class Polygons:
    """Polygons over the vertices of a mesh, and their materials.

    Triangles are cut from them in order, two fewer than a polygon has corners. Equal
    contents are equal and have one hash, so that it may be static in a traced function.

    Attributes:
        counts: Corners of each polygon, shape [polygons].
        corners: Vertices, polygon after polygon, shape [corners].
        uv_corners: Rows of texture coordinates, shape [corners]; or None.
        material: Which of ``materials`` each has, -1 for none, shape [polygons].
        materials: Materials.
    """

    counts: Int[np.ndarray, " polygons"]
    corners: Int[np.ndarray, " corners"]
    uv_corners: Int[np.ndarray, " corners"] | None
    material: Int[np.ndarray, " polygons"]
    materials: tuple[Material, ...] = ()

    @functools.cached_property
    def of_triangle(self) -> Int[np.ndarray, " faces"]:
        """The polygon that each triangle was cut from."""
        return np.repeat(np.arange(len(self.counts)), self.counts - 2)

    @functools.cached_property
    def starts(self) -> Int[np.ndarray, " polygons"]:
        """Where the corners of each polygon begin."""
        return np.cumsum(self.counts) - self.counts

    def at(self, vertices: Int[np.ndarray, " vertices"]) -> "Polygons | None":
        """The same polygons over other rows of vertices.

        Args:
            vertices: The new row of each vertex.

        Returns:
            None if corners of a polygon fall together: then triangles are all there is.
        """
        moved = dataclasses.replace(self, corners=vertices[self.corners].astype(np.int32))
        rows = np.repeat(np.arange(len(moved.counts)), moved.counts)
        pairs = np.unique(np.stack([rows, moved.corners], axis=1), axis=0)
        return moved if len(pairs) == len(moved.corners) else None

    def chosen(self, polygons: Sequence[int] | Int[np.ndarray, " chosen"]) -> "Polygons":
        """Some of the polygons, in the order given."""
        rows = np.asarray(polygons, np.int64)
        slots = np.concatenate(
            [np.arange(a, a + n) for a, n in zip(self.starts[rows], self.counts[rows])]
            or [np.zeros(0, np.int64)]
        )
        return Polygons(
            self.counts[rows],
            self.corners[slots],
            None if self.uv_corners is None else self.uv_corners[slots],
            self.material[rows],
            self.materials,
        )

    def reversed(self, polygons: Sequence[int] | Int[np.ndarray, " turned"]) -> "Polygons":
        """Some of the polygons turned round, each from the corner that it begins with."""
        slots = np.arange(len(self.corners))
        for p in np.asarray(polygons, np.int64):
            a, n = self.starts[p], self.counts[p]
            slots[a + 1 : a + n] = slots[a + 1 : a + n][::-1].copy()
        return dataclasses.replace(
            self,
            corners=self.corners[slots],
            uv_corners=None if self.uv_corners is None else self.uv_corners[slots],
        )

    @functools.cached_property
    def _digest(self) -> bytes:
        whole = hashlib.sha256(repr(self.materials).encode())
        for m in self.materials:
            image = None if m.texture is None else m.texture.data
            whole.update(b"-" if image is None else hashlib.sha256(image).digest())
        for x in (self.counts, self.corners, self.uv_corners, self.material):
            whole.update(b"-" if x is None else np.ascontiguousarray(x, np.int64).tobytes() + b"+")
        return whole.digest()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Polygons) and self._digest == other._digest

    def __hash__(self) -> int:
        return hash(self._digest)


def joined_polygons(parts: Sequence[tuple[Polygons, int, int]]) -> Polygons:
    """Polygons of several meshes as those of one.

    Args:
        parts: Of each mesh its polygons, how many vertices it has, and how many rows of
            texture coordinates.

    Raises:
        MeshError: Nothing to join.
    """
    if not parts:
        raise MeshError("no polygons to join: give at least one mesh.")
    materials = tuple(dict.fromkeys(m for p, _, _ in parts for m in p.materials))
    number = {m: k for k, m in enumerate(materials)}
    counts, corners, uv_corners, material = [], [], [], []
    first = row = 0
    for p, vertices, uvs in parts:
        counts.append(p.counts)
        corners.append(p.corners + first)
        if p.uv_corners is not None:
            uv_corners.append(p.uv_corners + row)
        # The last is what -1 finds.
        material.append(np.asarray([*(number[m] for m in p.materials), -1])[p.material])
        first, row = first + vertices, row + uvs
    textured = len(uv_corners) == len(parts)
    return Polygons(
        np.concatenate(counts),
        np.concatenate(corners),
        np.concatenate(uv_corners) if textured else None,
        np.concatenate(material),
        materials,
    )
