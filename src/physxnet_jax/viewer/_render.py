"""Off-screen rendering of dressed people: pictures and videos."""

import contextlib
import importlib
import importlib.util
import pathlib
import threading
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import UInt8

from ..errors import FormatError, MissingDependencyError
from ..files import atomic_write, check_writable
from ..io import AnimatedMesh
from ._studio import Camera, Studio, background_colours

PREVIEWS = (".mp4", ".gif", ".png")
_MAX_SIDE, _MAX_STRIP = 7680, 24


def render_frame(
    meshes: Sequence[AnimatedMesh],
    frame: int = 0,
    *,
    size: tuple[int, int] = (640, 720),
    camera: Camera = "three-quarter",
    background: str = "studio",
) -> UInt8[np.ndarray, "height width 3"]:
    """One frame as an RGB image.

    Args:
        meshes: Meshes to render, the person first.
        frame: The frame.
        size: Width and height.
        camera: As for `render_preview`.
        background: As for `render_preview`.

    Raises:
        FormatError: No such camera or background.
        MissingDependencyError: Without the ``render`` extra.
    """
    studio = Studio(meshes, size, camera=camera, background=background, still=True)
    try:
        return studio.draw(frame)
    finally:
        studio.close()


def render_preview(
    path: str | pathlib.Path,
    meshes: Sequence[AnimatedMesh],
    fps: float,
    *,
    size: tuple[int, int] = (480, 544),
    camera: Camera = "three-quarter",
    background: str = "studio",
    strip: int = 1,
    progress: Callable[[str, int, int], None] | None = None,
) -> pathlib.Path:
    """Renders a clip as ``.mp4`` or ``.gif``, or a moment of it as ``.png``.

    Args:
        path: Output file, written atomically.
        meshes: Meshes to render, the person first.
        fps: Frames per second.
        size: Width and height of a frame; multiples of 16 for video.
        camera: ``three-quarter``, ``front``, ``back``, ``follow`` (turns with the person) or
            ``turntable``. All keep the person in the middle.
        background: ``studio``, ``white``, ``grey``, ``dark`` or ``#rrggbb``.
        strip: Number of moments side by side in a ``.png``, spread over the clip; one is the
            clip's middle.
        progress: Called with a text, the frames done and the total.

    Raises:
        FormatError: Another extension, or no such camera or background.
        MissingDependencyError: Without the ``render`` extra.
    """
    return render_columns(
        path,
        {"": meshes},
        fps,
        size=size,
        camera=camera,
        background=background,
        strip=strip,
        progress=progress,
    )


def render_columns(
    path: str | pathlib.Path,
    columns: Mapping[str, Sequence[AnimatedMesh]],
    fps: float,
    *,
    size: tuple[int, int] = (480, 544),
    camera: Camera = "three-quarter",
    background: str = "studio",
    strip: int = 6,
    progress: Callable[[str, int, int], None] | None = None,
) -> pathlib.Path:
    """Renders clips of the same motion side by side, from the same viewpoint.

    Args:
        path: ``.mp4``, ``.gif``, or ``.png`` (a row for each column's title); written
            atomically.
        columns: Meshes to render, by the title above them.
        fps: Frames per second.
        size: Width and height of one column; multiples of 16 for video.
        camera: As for `render_preview`.
        background: As for `render_preview`.
        strip: Number of moments in a row of a ``.png``.
        progress: Called with a text, the frames done and the total.

    Raises:
        FormatError: Another extension, clips of different lengths, or no such camera or
            background.
        MissingDependencyError: Without the ``render`` extra.
    """
    path = check_preview(path, size, background, strip)
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
    studios: list[Studio] = []
    look: dict[str, Any] = {"camera": camera, "background": background, "fps": fps}
    options: dict[str, Any]
    still = path.suffix.lower() == ".png"
    try:
        for title, meshes in columns.items():
            studios.append(Studio(meshes, size, title=title, still=still, **look))
        with atomic_write(path) as part, warnings.catch_warnings():
            # ffmpeg is started by fork and exec: no JAX code runs in between.
            warnings.filterwarnings("ignore", message=".*os.fork.*")
            if still:
                chosen = np.unique(_moments(frames, strip))
                rows = []
                for studio in studios:
                    rows.append(np.concatenate([studio.draw(int(k)) for k in chosen], axis=1))
                    if progress is not None:
                        progress("preview", len(rows), len(studios))
                imageio.imwrite(part, np.concatenate(rows, axis=0))
                return path
            video = path.suffix.lower() == ".mp4"
            stride = 1 if video else max(1, round(fps / 15))
            if video:
                options = {"fps": fps, "codec": "libx264", "macro_block_size": 16}
            else:
                options = {"duration": 1000 * stride / fps, "loop": 0}
            with imageio.get_writer(part, **options) as writer:
                for k in range(0, frames, stride):
                    shot = np.concatenate([s.draw(k) for s in studios], axis=1)
                    writer.append_data(shot)  # pyright: ignore[reportAttributeAccessIssue]
                    if progress is not None:
                        progress("preview", min(k + stride, frames), frames)
    finally:
        for s in studios:
            s.close()
    return path


def _moments(frames: int, count: int) -> np.ndarray:
    """Frames spread over a clip; the middle one for a count of 1."""
    if count == 1:
        return np.array([frames // 2])
    return np.linspace(0, frames - 1, count).astype(int)


def load_renderer() -> None:
    """Starts to load the renderer in a thread, in the shadow of work that holds no lock.

    Loading takes seconds, while a compiler or a compiled program is often all that runs.
    """

    def load() -> None:
        # Whoever draws will report what is missing.
        with contextlib.suppress(ImportError):
            importlib.import_module("pyvista")

    threading.Thread(target=load, name="load the renderer", daemon=True).start()


def check_preview(
    path: str | pathlib.Path,
    size: tuple[int, int] = (480, 544),
    background: str = "studio",
    strip: int = 1,
) -> pathlib.Path:
    """Checks that a preview can be rendered to a path, and returns the path.

    Args:
        path: Output file.
        size: Width and height of a frame.
        background: As for `render_preview`.
        strip: As for `render_preview`.

    Raises:
        FormatError: Another extension, a size or number that can't be rendered, no such
            background, or the path isn't writable.
        MissingDependencyError: Without the ``render`` extra.
    """
    path = pathlib.Path(path)
    if path.suffix.lower() not in PREVIEWS:
        raise FormatError(f"{path}: a preview is one of {', '.join(PREVIEWS)}.")
    video = path.suffix.lower() == ".mp4"
    wrong = any(n < 16 or n > _MAX_SIDE or (video and n % 16) for n in size)
    if wrong:
        multiple = ", multiples of 16 for .mp4" if video else ""
        raise FormatError(
            f"the size is {size[0]} x {size[1]}, expected 16 to {_MAX_SIDE} pixels{multiple}."
        )
    if not 1 <= strip <= _MAX_STRIP:
        raise FormatError(f"strip is {strip}, expected 1 to {_MAX_STRIP} moments.")
    background_colours(background)
    needed = ["pyvista", "imageio", *(["imageio_ffmpeg"] if path.suffix.lower() == ".mp4" else [])]
    if any(importlib.util.find_spec(name) is None for name in needed):
        raise MissingDependencyError("Pictures need pyvista: pip install 'physxnet-jax[render]'.")
    check_writable(path)
    return path
