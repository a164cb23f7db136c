"""Off-screen rendering of dressed people: pictures and videos."""

import importlib.util
import io
import os
import pathlib
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from ..errors import FormatError, MissingDependencyError
from ..files import atomic_write, check_writable
from ..geometry import Texture
from ..io import AnimatedMesh, smooth_normals

PREVIEWS = (".mp4", ".gif", ".png")
# Minimum height of the view above the floor [m].
_SPAN = 1.8


def _plotter(size: tuple[int, int]) -> Any:
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
    plotter = pyvista.Plotter(off_screen=True, window_size=list(size), lighting="three lights")
    plotter.set_background("white", top="#cfd8e3")  # pyright: ignore[reportArgumentType]
    return plotter


class _Stage:
    """A scene whose meshes are updated from frame to frame."""

    def __init__(
        self, meshes: Sequence[AnimatedMesh], size: tuple[int, int], title: str = ""
    ) -> None:
        import pyvista

        self.plotter = _plotter(size)
        if title:
            self.plotter.add_text(title, position="upper_edge", font_size=12, color="#202428")
        self.meshes = meshes
        self.images: dict[Texture, Any] = {}
        self.floor = float(min(m.positions[..., 1].min() for m in meshes))
        # High jumps and raised arms have to stay in view.
        top = float(max(m.positions[..., 1].max() for m in meshes))
        self.span = max(top - self.floor, _SPAN)
        path = np.concatenate([m.positions.mean(axis=1) for m in meshes[:1]])
        middle, reach = path.mean(axis=0), 2.5 + np.ptp(path, axis=0).max()
        ground = pyvista.Plane(
            center=(middle[0], self.floor - 0.002, middle[2]),
            direction=(0, 1, 0),
            i_size=2 * reach,
            j_size=2 * reach,
            i_resolution=20,
            j_resolution=20,
        )
        self.plotter.add_mesh(ground, color="#b9bec4", show_edges=True, edge_color="#a4a9b0")

    def draw(self, frame: int) -> np.ndarray:
        """One frame as an RGB image."""
        import pyvista

        centre = self.meshes[0].positions[frame].mean(axis=0)
        for k, m in enumerate(self.meshes):
            looks = m.looks
            if any(look.texture is not None for look in looks):
                self._add_textured(k, m, frame)
                continue
            colour_options: dict[str, Any] = {"color": looks[0].colour}
            if len(looks) > 1:
                face_colours = np.zeros((len(m.faces), 3), np.uint8)
                for look in looks:
                    face_colours[look.faces] = np.round(255 * np.asarray(look.colour))
                colour_options = {"scalars": face_colours, "rgb": True}
            # Named meshes replace the last frame's; smooth shading needs new normals anyway.
            self.plotter.add_mesh(
                pyvista.PolyData.from_regular_faces(m.positions[frame].copy(), m.faces),
                name=f"mesh{k}",
                smooth_shading=True,
                specular=0.1,
                reset_camera=False,
                backface_params={"color": tuple(0.6 * c for c in looks[0].colour)},
                **colour_options,
            )
        target = np.array([centre[0], self.floor + 0.5 * self.span, centre[2]])
        eye = target + np.array([1.3, 0.5, 3.4]) * (self.span / _SPAN)
        self.plotter.camera_position = [tuple(eye), tuple(target), (0.0, 1.0, 0.0)]
        self.plotter.camera.view_angle = 32.0
        # A screenshot alone would show the meshes from the camera's previous position.
        self.plotter.render()
        return np.asarray(self.plotter.screenshot(return_img=True))

    def _add_textured(self, k: int, m: AnimatedMesh, frame: int) -> None:
        """Adds a mesh of which some faces are textured, with a separate mesh for each look."""
        import pyvista

        normals = smooth_normals(m.positions[frame : frame + 1], m.faces)[0]
        for n, look in enumerate(m.looks):
            corners = m.faces[look.faces].reshape(-1)
            part = pyvista.PolyData.from_regular_faces(
                m.positions[frame][corners], np.arange(len(corners)).reshape(-1, 3)
            )
            part.point_data.active_normals = normals[corners]
            image = None
            if look.texture is not None and m.uv is not None and m.uv_faces is not None:
                part.active_texture_coordinates = m.uv[m.uv_faces[look.faces].reshape(-1)]
                image = self._load_texture(look.texture)
            self.plotter.add_mesh(
                part,
                name=f"mesh{k}_{n}",
                color=look.colour,
                texture=image,
                smooth_shading=True,
                specular=0.1,
                reset_camera=False,
            )

    def _load_texture(self, texture: Texture) -> Any:
        import imageio.v2 as imageio
        import pyvista

        if texture not in self.images:
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
            self.images[texture] = made
        return self.images[texture]


def render_frame(
    meshes: Sequence[AnimatedMesh], frame: int = 0, *, size: tuple[int, int] = (640, 720)
) -> np.ndarray:
    """One frame as an RGB image, shape [height, width, 3].

    Raises:
        MissingDependencyError: Without the ``render`` extra.
    """
    stage = _Stage(meshes, size)
    try:
        return stage.draw(frame)
    finally:
        stage.plotter.close()


def render_preview(
    path: str | pathlib.Path,
    meshes: Sequence[AnimatedMesh],
    fps: float,
    *,
    size: tuple[int, int] = (480, 544),
    progress: Callable[[str, int, int], None] | None = None,
) -> pathlib.Path:
    """Renders a clip: ``.mp4``, ``.gif``, or ``.png`` (a contact sheet of six frames).

    Args:
        path: Output file, written atomically.
        meshes: Meshes to render.
        fps: Frames per second.
        size: Width and height of a frame; multiples of 16 for video.
        progress: Called with a text, the frames done and the total.

    Raises:
        FormatError: Another extension.
        MissingDependencyError: Without the ``render`` extra.
    """
    return render_columns(path, {"": meshes}, fps, size=size, progress=progress)


def render_columns(
    path: str | pathlib.Path,
    columns: Mapping[str, Sequence[AnimatedMesh]],
    fps: float,
    *,
    size: tuple[int, int] = (480, 544),
    progress: Callable[[str, int, int], None] | None = None,
) -> pathlib.Path:
    """Renders clips of the same motion side by side, from the same viewpoint.

    Args:
        path: ``.mp4``, ``.gif``, or ``.png`` (six frames, a row for each column's title);
            written atomically.
        columns: Meshes to render, by the title above them.
        fps: Frames per second.
        size: Width and height of one column; multiples of 16 for video.
        progress: Called with a text, the frames done and the total.

    Raises:
        FormatError: Another extension, or clips of different lengths.
        MissingDependencyError: Without the ``render`` extra.
    """
    path = check_preview(path)
    lengths = {len(meshes[0].positions) for meshes in columns.values()}
    if len(lengths) != 1:
        raise FormatError(
            f"clips to compare have {sorted(lengths)} frames; the numbers must be equal."
        )
    try:
        import imageio.v2 as imageio
    except ImportError as error:
        raise MissingDependencyError(
            "Videos need imageio: pip install 'physxnet-jax[render]'."
        ) from error
    (frames,) = lengths
    stages: list[_Stage] = []
    try:
        for title, meshes in columns.items():
            stages.append(_Stage(meshes, size, title))
        with atomic_write(path) as part, warnings.catch_warnings():
            # ffmpeg is started by fork and exec: no JAX code runs in between.
            warnings.filterwarnings("ignore", message=".*os.fork.*")
            if path.suffix.lower() == ".png":
                sampled = np.unique(np.linspace(0, frames - 1, 6).astype(int))
                rows = [np.concatenate([s.draw(int(k)) for k in sampled], axis=1) for s in stages]
                imageio.imwrite(part, np.concatenate(rows, axis=0))
                return path
            stride = 1 if path.suffix.lower() == ".mp4" else max(1, round(fps / 15))
            options: dict[str, Any] = (
                {"fps": fps, "codec": "libx264", "macro_block_size": 16}
                if stride == 1 and path.suffix.lower() == ".mp4"
                else {"duration": 1000 * stride / fps, "loop": 0}
            )
            with imageio.get_writer(part, **options) as writer:
                for k in range(0, frames, stride):
                    shot = np.concatenate([s.draw(k) for s in stages], axis=1)
                    writer.append_data(shot)  # pyright: ignore[reportAttributeAccessIssue]
                    if progress is not None:
                        progress("preview", k + 1, frames)
    finally:
        for s in stages:
            s.plotter.close()
    return path


def check_preview(path: str | pathlib.Path) -> pathlib.Path:
    """Checks that a preview can be rendered to a path, and returns the path.

    Raises:
        FormatError: Another extension, or the path isn't writable.
        MissingDependencyError: Without the ``render`` extra.
    """
    path = pathlib.Path(path)
    if path.suffix.lower() not in PREVIEWS:
        raise FormatError(f"{path}: a preview is one of {', '.join(PREVIEWS)}.")
    needed = ["pyvista", "imageio", *(["imageio_ffmpeg"] if path.suffix.lower() == ".mp4" else [])]
    if any(importlib.util.find_spec(name) is None for name in needed):
        raise MissingDependencyError("Pictures need pyvista: pip install 'physxnet-jax[render]'.")
    check_writable(path)
    return path
