"""Meshes that readers return and writers take: static and animated."""

import dataclasses
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Int

from ..frames import moved_frames
from ..geometry import Material, Polygons, Texture


@dataclasses.dataclass(frozen=True)
class AnimatedMesh:
    """An animated mesh of constant topology.

    Attributes:
        name: Name of the mesh.
        positions: Vertex positions [m], Y up, shape [frames, vertices, 3].
        faces: Triangles, shape [faces, 3].
        uv: Texture coordinates, shape [uvs, 2]; or None.
        uv_faces: Corners in ``uv``, shape [faces, 3]; or None.
        colour: Display colour, linear RGB in [0, 1].
        polygons: Polygons that the triangles were cut from, with materials; or None.
        skinning: The skeleton that moves it, if nothing else does; or None.
    """

    name: str
    positions: Float[np.ndarray, "frames vertices 3"]
    faces: Int[np.ndarray, "faces 3"]
    uv: Float[np.ndarray, "uvs 2"] | None = None
    uv_faces: Int[np.ndarray, "faces 3"] | None = None
    colour: tuple[float, float, float] = (0.6, 0.6, 0.6)
    polygons: Polygons | None = None
    skinning: "Skinning | None" = None

    def moved(self, by: Float[np.ndarray, "3"]) -> "AnimatedMesh":
        """The mesh displaced [m]; the same if that is zero."""
        if not by.any():
            return self
        s = self.skinning
        skinning = s and dataclasses.replace(s, translations=s.translations + by)
        return dataclasses.replace(
            self, positions=moved_frames(self.positions, by), skinning=skinning
        )

    @property
    def looks(self) -> list["Look"]:
        """The look of each material, and the mesh's own for faces without one."""
        p = self.polygons
        if p is None or not p.materials:
            return [Look(self.name, self.colour, np.arange(len(self.faces)))]
        of_face = p.material[p.of_triangle]
        found = [self._look(m, np.flatnonzero(of_face == k)) for k, m in enumerate(p.materials)]
        found.append(Look(self.name, self.colour, np.flatnonzero(of_face < 0)))
        return [look for look in found if len(look.faces)]

    def _look(self, m: Material, faces: Int[np.ndarray, " faces"]) -> "Look":
        image = m.texture
        if image is None or image.data is None or self.uv is None or self.uv_faces is None:
            return Look(m.name, self.colour if m.colour is None else m.colour, faces)
        return Look(m.name, (1.0, 1.0, 1.0) if m.colour is None else m.colour, faces, image)


@dataclasses.dataclass(frozen=True)
class Skinning:
    """Linear blend skinning: ``positions[f] = sum_j weights[:, j] (R[f, j] rest + t[f, j])``.

    Attributes:
        rest: Vertices at rest [m], shape [vertices, 3].
        heads: Positions of the joints at rest [m], shape [joints, 3].
        names: Names of the joints.
        parents: Parent of every joint, -1 for the root; parents come first.
        weights: Skinning weights, shape [vertices, joints].
        rotations: World rotations R, shape [frames, joints, 3, 3].
        translations: World translations t [m], shape [frames, joints, 3].
    """

    rest: Float[np.ndarray, "vertices 3"]
    heads: Float[np.ndarray, "joints 3"]
    names: tuple[str, ...]
    parents: tuple[int, ...]
    weights: Float[np.ndarray, "vertices joints"]
    rotations: Float[np.ndarray, "frames joints 3 3"]
    translations: Float[np.ndarray, "frames joints 3"]


class Look(NamedTuple):
    """Appearance of some faces of a mesh.

    Attributes:
        name: Name of the material.
        colour: Linear RGB in [0, 1], by which a texture is multiplied.
        faces: The triangles, shape [faces].
        texture: Image on these faces; None without one.
    """

    name: str
    colour: tuple[float, float, float]
    faces: Int[np.ndarray, " faces"]
    texture: Texture | None = None


@dataclasses.dataclass(frozen=True)
class StaticMesh:
    """A triangulated mesh in its file's unit and axes.

    Attributes:
        vertices: Positions in the file's unit, in the file's order, shape [vertices, 3].
        faces: Triangles, shape [faces, 3].
        uv: Texture coordinates, shape [uvs, 2]; None if any face lacks them.
        uv_faces: Corners in ``uv``, shape [faces, 3]; None likewise.
        polygons: The faces before triangulation, with materials; None if they can't be
            recovered from the triangles.
        count: Number of faces before triangulation.
        parts: Names of the meshes that it was joined from, if the file names them.
        unit: The unit that the file declares, ``m``; None if it declares none.
        up: The up axis that it declares, ``y`` or ``z``; None if it declares none.
    """

    vertices: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]
    uv: Float[np.ndarray, "uvs 2"] | None
    uv_faces: Int[np.ndarray, "faces 3"] | None
    polygons: Polygons | None
    count: int
    parts: tuple[str, ...] = ()
    unit: str | None = None
    up: str | None = None


def vertex_velocities(
    positions: Float[np.ndarray, "frames vertices 3"], fps: float
) -> Float[np.ndarray, "frames vertices 3"]:
    """Velocities towards the next frame [m/s]; the last frame repeats those before it.

    Renderers extrapolate a frame's points along them until the next frame.
    """
    out = np.zeros_like(positions)
    if len(positions) > 1:
        out[:-1] = (positions[1:] - positions[:-1]) * fps
        out[-1] = out[-2]
    return out


def smooth_normals(
    positions: Float[np.ndarray, "frames vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> Float[np.ndarray, "frames vertices 3"]:
    """Area-weighted unit vertex normals of every frame."""
    out = np.zeros(positions.shape, dtype=np.float32)
    count = positions.shape[1]
    # Sums the triangles around each vertex.
    corners = np.arange(3 * len(faces)) // 3
    around = sp.csr_matrix(
        (np.ones(3 * len(faces), np.float32), (faces.reshape(-1), corners)), (count, len(faces))
    )
    for k, x in enumerate(positions):
        a, b, c = (x[faces[:, i]] for i in range(3))
        u, v = b - a, c - a
        n = np.stack(
            [u[:, i] * v[:, j] - u[:, j] * v[:, i] for i, j in ((1, 2), (2, 0), (0, 1))], 1
        )
        out[k] = around @ n.astype(np.float32)
        out[k] /= np.maximum(np.sqrt((out[k] ** 2).sum(axis=1, keepdims=True)), 1e-12)
    return out
