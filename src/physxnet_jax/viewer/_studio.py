"""An off-screen studio: meshes that are updated from frame to frame, cameras, light and floor."""

import io
import os
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, UInt8
from scipy.ndimage import gaussian_filter, gaussian_filter1d

from ..body import NUM_BODY_VERTICES, load_body
from ..errors import FormatError, MissingDependencyError
from ..geometry import Texture
from ..io import AnimatedMesh, Look, smooth_normals

Camera = Literal["three-quarter", "front", "back", "follow", "turntable"]
CAMERAS: tuple[Camera, ...] = ("three-quarter", "front", "back", "follow", "turntable")
# How far the camera is turned from where the person faces, of those that aren't beside [rad].
_TURNED = {"front": 0.0, "back": float(np.pi)}
BACKGROUNDS: dict[str, tuple[str, str]] = {
    "studio": ("#f1f3f5", "#cdd5de"),
    "white": ("#ffffff", "#ffffff"),
    "grey": ("#8b9096", "#6c7278"),
    "dark": ("#2b2f36", "#16181c"),
}
"""Colours at the floor and at the top, by name."""

# Angle of the camera beside the person's front, and above the horizon [degrees].
_BESIDE, _ABOVE = 24.0, 9.0
# Field of view [degrees], and the share of it that the person fills.
_VIEW, _FILLED = 26.0, 0.9
# Distance of the trunk from the vertical axis, over the person's height.
_TRUNK = 0.09
# Cameras follow with this delay [s].
_DELAY = 0.25
# Pictures are drawn larger and made smaller: cheaper than samples within a pixel. Those of videos,
# whose edges move, less so than single ones, unless these would have more pixels on a side.
_FINER, _FINEST, _LARGEST = 1.5, 3.0, 8192
# Half of the floor's width [m], its pixels, and the distance of its lines [m].
_REACH, _PIXELS, _GRID = 2.6, 384, 0.5
# Vertices by height above the floor [m]: blur of their shadow [m], its strength, and the pixels
# of its picture on each side.
_SHADOWS = ((0.12, 0.025, 1.0, 384), (0.6, 0.07, 0.55, 192), (9.0, 0.16, 0.4, 96))


def make_plotter(size: tuple[int, int]) -> Any:
    """An off-screen plotter with soft light from the camera's side.

    Raises:
        MissingDependencyError: Without the ``render`` extra.
    """
    try:
        import pyvista
    except ImportError as error:
        raise MissingDependencyError(
            "Pictures need pyvista: pip install 'physxnet-jax[render]'."
        ) from error
    # Without a display VTK tries X first and logs errors; it then falls back to EGL.
    if "DISPLAY" not in os.environ:
        import vtk

        vtk.vtkLogger.SetStderrVerbosity(vtk.vtkLogger.VERBOSITY_OFF)
    return pyvista.Plotter(off_screen=True, window_size=list(size), lighting="light kit")


def background_colours(background: str) -> tuple[str, str]:
    """Colours at the floor and at the top, of a name or of ``#rrggbb``.

    Raises:
        FormatError: Neither.
    """
    if background in BACKGROUNDS:
        return BACKGROUNDS[background]
    digits = background.removeprefix("#")
    if (
        background.startswith("#")
        and len(digits) == 6
        and set(digits) <= set("0123456789abcdefABCDEF")
    ):
        return background, background
    raise FormatError(
        f"no background '{background}'; there are {', '.join(BACKGROUNDS)} and #rrggbb."
    )


def displayed(colour: tuple[float, float, float]) -> tuple[float, float, float]:
    """A linear colour, encoded for the screen."""
    r, g, b = (float(np.clip(c, 0.0, 1.0)) ** (1 / 2.2) for c in colour)
    return r, g, b


def headings(meshes: Sequence[AnimatedMesh]) -> Float[np.ndarray, " frames"]:
    """Angle about the vertical axis in which the first mesh faces, unwrapped [rad].

    The best turn about Y onto the body at rest, which faces along Z, for the built-in body;
    onto the first frame for others.
    """
    x = meshes[0].positions
    first = x[0]
    if meshes[0].name == "body" and x.shape[1] == NUM_BODY_VERTICES:
        body = load_body()
        first = np.asarray(body.rest_vertices(body.default_shape()))[:NUM_BODY_VERTICES]
    # The trunk alone: arms swing, and far from the axis they count most.
    away = np.linalg.norm((first - first.mean(axis=0))[:, [0, 2]], axis=1)
    trunk = np.flatnonzero(away < _TRUNK * max(float(np.ptp(first[:, 1])), 1e-6))
    rows = trunk[:: max(1, len(trunk) // 800)] if len(trunk) > 3 else np.arange(x.shape[1])
    a, b = first[rows][:, [0, 2]], x[:, rows][:, :, [0, 2]]
    a, b = a - a.mean(axis=0), b - b.mean(axis=1, keepdims=True)
    along = np.einsum("vc,fvc->f", a, b)
    across = np.einsum("v,fv->f", a[:, 1], b[:, :, 0]) - np.einsum("v,fv->f", a[:, 0], b[:, :, 1])
    return np.unwrap(np.arctan2(across, along))


class Studio:
    """Meshes with one look, seen by one camera.

    Args:
        meshes: Meshes to show, the person first [m], Y up.
        size: Width and height of the picture.
        fps: Frames per second, for the camera's motion.
        camera: ``three-quarter``, ``front`` and ``back`` look from a fixed direction, as the
            person faces on average in the first second; ``follow`` turns with the person;
            ``turntable`` goes around once. All keep the person in the middle.
        background: A name in `BACKGROUNDS`, or ``#rrggbb``.
        title: Text above the picture.
        still: For single pictures: smoother edges, in more time.
    """

    def __init__(
        self,
        meshes: Sequence[AnimatedMesh],
        size: tuple[int, int],
        *,
        fps: float = 30.0,
        camera: Camera = "three-quarter",
        background: str = "studio",
        title: str = "",
        still: bool = False,
    ) -> None:
        low, high = background_colours(background)
        if camera not in CAMERAS:
            raise FormatError(f"no camera '{camera}'; there are {', '.join(CAMERAS)}.")
        self._size = size
        finer = max(_FINER, min(_FINEST, _LARGEST / max(size))) if still else _FINER
        self.plotter = make_plotter((round(finer * size[0]), round(finer * size[1])))
        self.plotter.set_background(low, top=high)
        self.plotter.disable_anti_aliasing()
        self.meshes = meshes
        self._images: dict[Texture, Any] = {}
        dark = sum(int(low[k : k + 2], 16) for k in (1, 3, 5)) < 3 * 110
        self._line = 235 if dark else 60
        if title:
            colour = "#e8eaed" if dark else "#202428"
            self.plotter.add_text(title, position="upper_edge", font_size=18, color=colour)
        self.floor = float(min(m.positions[..., 1].min() for m in meshes))
        self._frame(fps, camera, size)
        self._parts = [part for k, m in enumerate(meshes) for part in self._add(k, m)]
        self._ground = self._add_floor()

    def _frame(self, fps: float, camera: Camera, size: tuple[int, int]) -> None:
        """Where the camera looks in every frame, and from how far."""
        person = self.meshes[0].positions
        frames = len(person)
        width = _DELAY * fps
        middle = person.mean(axis=1)
        flat = gaussian_filter1d(middle.astype(float), max(width, 1e-3), axis=0, mode="nearest")
        turn = headings(self.meshes)
        about = np.full(frames, float(turn[: max(1, int(fps))].mean()))
        if camera == "follow":
            about = gaussian_filter1d(turn, max(2 * width, 1e-3), mode="nearest")
        elif camera == "turntable":
            about = about + np.linspace(0.0, 2.0 * np.pi, frames, endpoint=False)
        about = about + _TURNED.get(camera, float(np.radians(_BESIDE)))
        up = np.radians(_ABOVE)
        ahead = np.stack([np.sin(about), np.zeros(frames), np.cos(about)], axis=1)
        way = np.cos(up) * ahead + np.sin(up) * np.array([0.0, 1.0, 0.0])
        right = np.stack([ahead[:, 2], np.zeros(frames), -ahead[:, 0]], axis=1)
        top = float(max(m.positions[..., 1].max() for m in self.meshes))
        flat[:, 1] = 0.5 * (self.floor + top)
        above = np.cross(way, right)
        # Everything that is ever shown has to fit, high jumps and raised arms too.
        tangent = np.tan(np.radians(0.5 * _VIEW)) * _FILLED
        far = 0.0
        for m in self.meshes:
            gap = m.positions[:, ::7] - flat[:, None]
            toward, side, high = (
                np.einsum("fvc,fc->fv", gap, axis) for axis in (way, right, above)
            )
            wide = np.abs(side) * size[1] / size[0]
            far = max(far, float((np.maximum(wide, np.abs(high)) / tangent + toward).max()))
        self._targets, self._eyes = flat, flat + far * way

    def _add(self, k: int, m: AnimatedMesh) -> list[tuple[int, Look | None, Any, np.ndarray]]:
        """Adds a mesh: one part if nothing of it is textured, else one for each look."""
        import pyvista

        normals = smooth_normals(m.positions[:1], m.faces)[0]
        back = tuple(0.62 * c for c in displayed(m.looks[0].colour))
        options: dict[str, Any] = {
            "smooth_shading": True,
            "specular": 0.08,
            "ambient": 0.06,
            "reset_camera": False,
        }
        if not any(look.texture is not None for look in m.looks):
            part = pyvista.PolyData.from_regular_faces(m.positions[0].copy(), m.faces)
            part.point_data.active_normals = normals
            colours: dict[str, Any] = {"color": displayed(m.looks[0].colour)}
            if len(m.looks) > 1:
                each = np.zeros((len(m.faces), 3), np.uint8)
                for look in m.looks:
                    each[look.faces] = np.round(255 * np.asarray(displayed(look.colour)))
                colours = {"scalars": each, "rgb": True}
            self.plotter.add_mesh(part, backface_params={"color": back}, **colours, **options)
            return [(k, None, part, np.arange(m.positions.shape[1]))]
        parts = []
        for look in m.looks:
            corners = m.faces[look.faces].reshape(-1)
            part = pyvista.PolyData.from_regular_faces(
                m.positions[0][corners], np.arange(len(corners)).reshape(-1, 3)
            )
            part.point_data.active_normals = normals[corners]
            image = None
            if look.texture is not None and m.uv is not None and m.uv_faces is not None:
                part.active_texture_coordinates = m.uv[m.uv_faces[look.faces].reshape(-1)]
                image = self._load_texture(look.texture)
            self.plotter.add_mesh(part, color=displayed(look.colour), texture=image, **options)
            parts.append((k, look, part, corners))
        return parts

    def _add_floor(self) -> Any:
        import pyvista

        plane = pyvista.Plane(
            center=(0.0, 0.0, 0.0), direction=(0, 1, 0), i_size=2 * _REACH, j_size=2 * _REACH
        )
        # The texture's rows go along Z, its columns along X.
        x = np.asarray(plane.points)
        plane.active_texture_coordinates = np.stack(
            [0.5 + x[:, 0] / (2 * _REACH), 0.5 - x[:, 2] / (2 * _REACH)], axis=1
        ).astype(np.float32)
        # Lines and shadow fade away from the person.
        at = (np.arange(_PIXELS) + 0.5) * 2 * _REACH / _PIXELS - _REACH
        radius = np.hypot(at[:, None], at[None])
        fade = np.clip((_REACH - radius) / (0.7 * _REACH), 0.0, 1.0).astype(np.float32)
        self._line_alpha, self._shade_alpha = 0.22 * fade**2, 0.5 * fade**0.5
        blank = pyvista.Texture(np.zeros((_PIXELS, _PIXELS, 4), np.uint8))
        return self.plotter.add_mesh(plane, texture=blank, lighting=False, reset_camera=False)

    def draw(self, frame: int) -> UInt8[np.ndarray, "height width 3"]:
        """One frame as an RGB image."""
        import pyvista
        from PIL import Image

        normals = {}
        for k, _, part, rows in self._parts:
            m = self.meshes[k]
            if k not in normals:
                normals[k] = smooth_normals(m.positions[frame : frame + 1], m.faces)[0]
            part.points = m.positions[frame][rows]
            part.point_data.active_normals = normals[k][rows]
        target = self._targets[frame]
        self._ground.SetPosition(target[0], self.floor - 0.003, target[2])
        picture = pyvista.Texture(self._floor_picture(frame, target))
        picture.interpolate = True
        self._ground.texture = picture
        eye = self._eyes[frame]
        # pyvista's own setters look through all meshes for the range of depths.
        camera = self.plotter.camera
        camera.SetPosition(*eye)
        camera.SetFocalPoint(*target)
        camera.SetViewUp(0.0, 1.0, 0.0)
        camera.SetViewAngle(_VIEW)
        camera.SetClippingRange(0.05, 100.0)
        # A screenshot alone would show the meshes from the camera's previous position.
        self.plotter.render()
        picture = Image.fromarray(np.asarray(self.plotter.screenshot(return_img=True)))
        return np.asarray(picture.resize(self._size, Image.Resampling.HAMMING))

    def _floor_picture(
        self, frame: int, centre: Float[np.ndarray, "3"]
    ) -> UInt8[np.ndarray, "rows columns 4"]:
        """Lines that stay in their place and a soft shadow, over nothing."""
        from PIL import Image

        pixel = 2 * _REACH / _PIXELS
        light = np.ones((_PIXELS, _PIXELS), np.float32)
        x = np.concatenate([m.positions[frame] for m in self.meshes])
        height = x[:, 1] - self.floor
        bottom = -np.inf
        for top, blur, strength, pixels in _SHADOWS:
            part = x[(height >= bottom) & (height < top)]
            bottom = top
            # Light comes from above and a little from the front left.
            size = 2 * _REACH / pixels
            high = part[:, 1] - self.floor
            u = (part[:, 0] - centre[0] + 0.12 * high) / size + pixels / 2
            v = (part[:, 2] - centre[2] - 0.18 * high) / size + pixels / 2
            there = (np.minimum(u, v) >= 0) & (np.maximum(u, v) < pixels)
            covered = np.zeros((pixels, pixels), np.float32)
            covered[v[there].astype(int), u[there].astype(int)] = 1.0
            covered = strength * np.clip(1.6 * gaussian_filter(covered, blur / size), 0.0, 1.0)
            if pixels < _PIXELS:
                larger = Image.fromarray(covered).resize(
                    (_PIXELS, _PIXELS), Image.Resampling.BILINEAR
                )
                covered = np.asarray(larger)
            light *= 1.0 - covered
        at = (np.arange(_PIXELS) + 0.5) * pixel - _REACH
        row, column = (
            np.clip(
                1.0 - np.abs((at + offset + 0.5 * _GRID) % _GRID - 0.5 * _GRID) / (1.1 * pixel),
                0.0,
                1.0,
            ).astype(np.float32)
            for offset in (centre[2], centre[0])
        )
        line = self._line_alpha * np.maximum(row[:, None], column[None])
        shade = self._shade_alpha * (1.0 - light)
        out = np.empty((_PIXELS, _PIXELS, 4), np.uint8)
        out[..., :3] = (self._line * line / np.maximum(line + shade, 1e-6))[..., None]
        out[..., 3] = 255 * (line + shade - line * shade)
        return out

    def _load_texture(self, texture: Texture) -> Any:
        import imageio.v2 as imageio
        import pyvista

        if texture not in self._images:
            try:
                pixels = np.asarray(imageio.imread(io.BytesIO(texture.data or b"")))
            # A damaged image is replaced by grey.
            except Exception:
                pixels = np.full((1, 1, 3), 200, np.uint8)
            if pixels.dtype == np.uint16:
                pixels = pixels >> 8
            if pixels.ndim == 2:
                pixels = np.repeat(pixels[..., None], 3, axis=2)
            pixels = pixels[..., :3] if pixels.shape[2] > 2 else pixels[..., :1].repeat(3, axis=2)
            made = pyvista.Texture(np.ascontiguousarray(pixels, np.uint8))
            made.repeat, made.interpolate = True, True
            self._images[texture] = made
        return self._images[texture]

    def close(self) -> None:
        """Frees the renderer."""
        self.plotter.close()
