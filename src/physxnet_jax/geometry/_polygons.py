"""Polygons and materials of a mesh file before triangulation, kept for export."""

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
        name: File name, without folders.
        data: Contents of the file, a PNG or a JPEG; None if it was missing or is neither.
    """

    name: str
    data: bytes | None = dataclasses.field(default=None, repr=False)

    @property
    def ending(self) -> str:
        """File extension of the format: ``.png`` or ``.jpg``."""
        return ".png" if self.data is None else _kind(self.data) or ".png"


def make_texture(name: str, data: bytes | None) -> Texture:
    """Builds a texture; data that is neither PNG nor JPEG is dropped.

    Args:
        name: File name; folders are removed.
        data: Contents of the file; None if it isn't available.
    """
    name = name.replace("\\", "/").rpartition("/")[2]
    return Texture(name, data if data is not None and _kind(data) else None)


def _kind(data: bytes) -> str | None:
    if data.startswith(b"\x89PNG\r\n\x1a\n"):
        return ".png"
    return ".jpg" if data.startswith(b"\xff\xd8\xff") else None


@dataclasses.dataclass(frozen=True)
class Material:
    """A material in a mesh file.

    Attributes:
        name: Name in the file.
        colour: Linear RGB in [0, 1], multiplied with the texture; None if the file has none.
        texture: Base colour image; None without one.
    """

    name: str
    colour: tuple[float, float, float] | None = None
    texture: Texture | None = None


def make_material(name: str, colour: object = None, texture: Texture | None = None) -> Material:
    """Builds a material; a colour that isn't three finite numbers becomes None.

    Args:
        name: Name of the material.
        colour: Linear RGB, clipped to [0, 1].
        texture: Base colour image.
    """
    rgb = np.zeros(0) if colour is None else np.asarray(colour)
    if rgb.shape != (3,) or rgb.dtype.kind not in "fiu" or not np.isfinite(rgb).all():
        return Material(name, texture=texture)
    r, g, b = np.clip(rgb.astype(float), 0.0, 1.0).tolist()
    return Material(name, (r, g, b), texture)


@dataclasses.dataclass(frozen=True, eq=False)
class Polygons:
    """Polygons over the vertices of a mesh, and their materials.

    A polygon with n corners has n - 2 triangles, in the order of the polygons. Equality and
    hash depend on contents, so instances can be static arguments of traced functions.

    Attributes:
        counts: Number of corners of each polygon, shape [polygons].
        corners: Vertex indices, polygon after polygon, shape [corners].
        uv_corners: Indices of texture coordinates, shape [corners]; or None.
        material: Index into ``materials``, -1 for none, shape [polygons].
        materials: Materials.
    """

    counts: Int[np.ndarray, " polygons"]
    corners: Int[np.ndarray, " corners"]
    uv_corners: Int[np.ndarray, " corners"] | None
    material: Int[np.ndarray, " polygons"]
    materials: tuple[Material, ...] = ()

    @functools.cached_property
    def of_triangle(self) -> Int[np.ndarray, " faces"]:
        """The polygon that each triangle belongs to."""
        return np.repeat(np.arange(len(self.counts)), self.counts - 2)

    @functools.cached_property
    def lost_images(self) -> tuple[str, ...]:
        """Names of images that the materials mention and that can't be used."""
        images = [m.texture for m in self.materials if m.texture is not None]
        return tuple(sorted({t.name for t in images if t.data is None}))

    @functools.cached_property
    def starts(self) -> Int[np.ndarray, " polygons"]:
        """Position of the first corner of each polygon in ``corners``."""
        return np.cumsum(self.counts) - self.counts

    def at(self, vertices: Int[np.ndarray, " vertices"]) -> "Polygons | None":
        """The same polygons with renumbered vertices.

        Args:
            vertices: The new index of each vertex.

        Returns:
            The polygons; None if corners of a polygon coincide, so that only triangles remain.
        """
        moved = dataclasses.replace(self, corners=vertices[self.corners].astype(np.int32))
        rows = np.repeat(np.arange(len(moved.counts)), moved.counts)
        pairs = np.unique(np.stack([rows, moved.corners], axis=1), axis=0)
        return moved if len(pairs) == len(moved.corners) else None

    def chosen(self, polygons: Sequence[int] | Int[np.ndarray, " chosen"]) -> "Polygons":
        """A selection of the polygons, in the given order."""
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
        """Reverses the winding of some polygons; each keeps its first corner."""
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
    """Joins the polygons of several meshes.

    Args:
        parts: For each mesh its polygons, its number of vertices and its number of texture
            coordinates.

    Raises:
        MeshError: There is nothing to join.
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
        # The last entry maps -1 to itself.
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
