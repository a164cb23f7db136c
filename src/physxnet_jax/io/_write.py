"""Writes clips in the format that the file's extension selects."""

import itertools
import pathlib
import re
from collections.abc import Sequence

import numpy as np

from ..errors import FormatError
from ..files import atomic_write, check_writable
from ._animated_mesh import AnimatedMesh
from ._gltf import check_gltf, write_gltf
from ._html import write_html
from ._mdd import write_mdd
from ._obj import write_materials, write_obj
from ._pc2 import write_pc2
from ._usd import check_usd, write_usd

EXTENSIONS = (".usdc", ".usd", ".usda", ".pc2", ".mdd", ".glb", ".html", ".obj", ".npz")
# Characters that file names may not contain on some system.
_INVALID = re.compile(r'[\\/:*?"<>|\x00-\x1f]')


def check_output(path: str | pathlib.Path, frames: int | None = None) -> pathlib.Path:
    """Checks that a clip can be written to a path, before minutes are spent on computing it.

    Args:
        path: Output path.
        frames: Number of frames, if known.

    Returns:
        The path.

    Raises:
        FormatError: The extension is unknown (the message lists the known ones), there are too
            many frames, or the path isn't writable.
        MissingDependencyError: A library that the format needs isn't installed.
    """
    path = pathlib.Path(path)
    if path.suffix.lower() not in EXTENSIONS:
        raise FormatError(
            f"{path}: can't write '{path.suffix}'; choose one of {', '.join(EXTENSIONS)}."
        )
    if path.suffix.lower().startswith(".usd"):
        check_usd()
    if path.suffix.lower() in (".glb", ".html"):
        check_gltf(path, frames)
    check_writable(path)
    return path


def write_clip(
    path: str | pathlib.Path,
    meshes: Sequence[AnimatedMesh],
    fps: float,
    *,
    velocities: bool = False,
) -> list[pathlib.Path]:
    """Writes a clip.

    ``.usdc``, ``.usd``, ``.usda``: one stage, the built-in body as a skeleton with a skin,
    with images of materials beside it as
    ``STEM_IMAGE.png``. ``.glb``: glTF with a morph target per frame. ``.html``: a page that
    plays the clip. ``.npz``: ``NAME_positions``, ``NAME_faces`` and ``fps``. ``.pc2``,
    ``.mdd``: for each mesh a cache and an OBJ of its first frame with the same vertex order,
    ``STEM_NAME.pc2`` and ``STEM_NAME.obj``. ``.obj``: a file for each mesh and frame,
    ``STEM_NAME_0000.obj``; files with the next numbers, left by a longer clip, are removed.
    If a mesh has materials, ``STEM_NAME.mtl`` and their images are written beside OBJ files.

    Args:
        path: Output path; its extension selects the format.
        meshes: Meshes to write [m], Y up, all with the same number of frames.
        fps: Frames per second.
        velocities: USD: write velocities too, for motion blur.

    Returns:
        The files written.

    Raises:
        FormatError: The extension is unknown, or there are too many frames for glTF.
        MissingDependencyError: A library that the format needs isn't installed.
    """
    path = check_output(path)
    suffix = path.suffix.lower()
    if suffix.startswith(".usd"):
        return write_usd(path, meshes, fps, velocities=velocities)
    if suffix == ".npz":
        arrays = {"fps": np.asarray(fps)}
        for m in meshes:
            arrays[f"{m.name}_positions"] = m.positions
            arrays[f"{m.name}_faces"] = m.faces
        with atomic_write(path) as part, part.open("wb") as file:
            np.savez_compressed(file, allow_pickle=False, **arrays)
        return [path]
    if suffix in (".glb", ".html"):
        write = write_gltf if suffix == ".glb" else write_html
        write(path, meshes, fps)
        return [path]
    written = []
    for m in meshes:
        stem = f"{path.stem}_{_INVALID.sub('_', m.name)}"
        drawn, library = m.polygons, None
        if drawn is not None and drawn.materials:
            library = f"{stem}.mtl"
            written += write_materials(path.with_name(library), drawn.materials)
        if suffix == ".obj":
            for k, x in enumerate(m.positions):
                frame = path.with_name(f"{stem}_{k:04d}.obj")
                write_obj(frame, x, m.faces, m.uv, m.uv_faces, polygons=drawn, library=library)
                written.append(frame)
            # Files left by a longer clip would be taken for the rest of this one.
            for k in itertools.count(len(m.positions)):
                left = path.with_name(f"{stem}_{k:04d}.obj")
                if not left.is_file():
                    break
                left.unlink()
            continue
        cache = path.with_name(f"{stem}{suffix}")
        if suffix == ".mdd":
            write_mdd(cache, m.positions, fps)
        else:
            write_pc2(cache, m.positions)
        shape = cache.with_suffix(".obj")
        write_obj(shape, m.positions[0], m.faces, m.uv, m.uv_faces, polygons=drawn, library=library)
        written += [cache, shape]
    return written
