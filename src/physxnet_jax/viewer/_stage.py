"""A dressed clip in a viser scene: bones move the bodies, garments are updated by vertex."""

from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from ..body import NUM_BODY_VERTICES, load_body
from ..io import AnimatedMesh
from ._job import Shown

BESIDE = np.array([-1.1, 0.0, 0.0], np.float32)
"""Displacement of the reference from the clip [m]."""

FARTHEST = 0.06
"""Distance at the end of the colour scale [m]."""

_SKIN = (176, 117, 84)


class Stage:
    """The meshes of a clip in a scene, updated from frame to frame.

    Attributes:
        shown: The clip.
    """

    def __init__(self, scene: Any, shown: Shown) -> None:
        self.shown = shown
        self._scene = scene
        self._person = scene.add_frame("/person", show_axes=False)
        self._middle = _middle(shown)
        self._floor = scene.add_grid(
            "/floor",
            width=20.0,
            height=20.0,
            plane="xz",
            cell_size=0.5,
            cell_color=(232, 232, 232),
            section_color=(205, 205, 205),
        )
        worn = shown.garments
        if shown.character is not None:
            worn = (shown.character.mesh, *worn)
        self._bodies = [] if shown.character is not None else [self._body("body")]
        self._meshes = [(m, np.zeros(3, np.float32), self._mesh(m, "")) for m in worn]
        self._dots = {}
        if shown.reference:
            beside = shown.reference
            if shown.character is None:
                self._bodies.append(self._body("reference/body"))
            else:
                beside = (shown.character.mesh, *beside)
            self._meshes += [(m, BESIDE, self._mesh(m, "reference/")) for m in beside]
        for m in shown.garments:
            if m.name in shown.distances:
                self._dots[m.name] = scene.add_point_cloud(
                    f"/person/distance/{m.name}",
                    m.positions[0],
                    heat(shown.distances[m.name][0]),
                    point_size=0.011,
                    point_shape="circle",
                )
        self.show(0)

    def show(
        self, frame: int, worn: dict[str, Float[np.ndarray, "vertices 3"]] | None = None
    ) -> None:
        """Shows a frame.

        Args:
            frame: Index of the frame.
            worn: Vertices of garments [m] that replace those of the clip.
        """
        shown = self.shown
        # The camera stays: person and floor move beneath it. Not by the frame that holds them: a
        # browser shows new vertices later than a new place, and cloth would lag behind.
        away = -self._middle[frame].astype(np.float32)
        self._floor.position = np.array([away[0] % 1.0, 0.0, away[2] % 1.0])
        turns = Rotation.from_matrix(shown.world[frame]).as_quat(scalar_first=True)
        for place, body in zip((0.0 * BESIDE, BESIDE), self._bodies, strict=False):
            for bone, q, p in zip(
                body.bones, turns, shown.shift[frame] + place + away, strict=True
            ):
                bone.wxyz, bone.position = q, p
        for mesh, place, handle in self._meshes:
            here = None if worn is None or place is BESIDE else worn.get(mesh.name)
            handle.vertices = (mesh.positions[frame] if here is None else here) + (place + away)
        for mesh in shown.garments:
            if mesh.name in self._dots:
                dots = self._dots[mesh.name]
                dots.points = mesh.positions[frame] + away
                dots.colors = heat(shown.distances[mesh.name][frame])

    def clear(self) -> None:
        """Removes all meshes from the scene."""
        self._person.remove()
        self._floor.remove()

    def _body(self, name: str) -> Any:
        body = load_body()
        joints = len(body.parents)
        return self._scene.add_mesh_skinned(
            f"/person/{name}",
            np.asarray(self.shown.rest[:NUM_BODY_VERTICES], np.float32),
            np.asarray(body.rest_mesh().faces).astype(np.uint32),
            bone_wxyzs=np.tile(np.array([1.0, 0.0, 0.0, 0.0]), (joints, 1)),
            bone_positions=np.zeros((joints, 3)),
            skin_weights=np.asarray(body.weights[:NUM_BODY_VERTICES]),
            color=_SKIN,
        )

    def _mesh(self, mesh: AnimatedMesh, folder: str) -> Any:
        # Display colours are linear; a browser expects gamma-encoded ones.
        most = max(mesh.looks, key=lambda look: len(look.faces)).colour
        colour = tuple(int(255 * c ** (1 / 2.2)) for c in most)
        if mesh.name in self.shown.distances and not folder:
            colour = (205, 205, 205)
        return self._scene.add_mesh_simple(
            f"/person/{folder}{mesh.name}",
            np.asarray(mesh.positions[0], np.float32),
            np.asarray(mesh.faces).astype(np.uint32),
            color=colour,
            side="double",
        )


def _middle(shown: Shown) -> Float[np.ndarray, "frames 3"]:
    """Where the person is on the floor [m], without swaying."""
    rest = shown.rest[:NUM_BODY_VERTICES]
    middle = 0.5 * (rest.min(axis=0) + rest.max(axis=0))
    path = shown.world[:, 0] @ middle + shown.shift[:, 0]
    path = gaussian_filter1d(path, 0.5 * shown.clip.fps, axis=0, mode="nearest")
    return path * np.array([1.0, 0.0, 1.0])


def heat(distances: Float[np.ndarray, " vertices"]) -> UInt8[np.ndarray, "vertices 3"]:
    """Blue for no distance, through white, to red at `FARTHEST`."""
    t = np.clip(distances / FARTHEST, 0.0, 1.0)[:, None]
    low, middle, high = (
        np.array([[40, 80, 200]]),
        np.array([[245, 245, 245]]),
        np.array([[200, 30, 30]]),
    )
    colour = np.where(t < 0.5, low + 2 * t * (middle - low), middle + (2 * t - 1) * (high - middle))
    return colour.astype(np.uint8)
