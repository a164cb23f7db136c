"""Writes clips in the format that the file's extension selects."""

import contextlib
import dataclasses
import itertools
import pathlib
import re
import zipfile
from collections.abc import Iterator, Sequence

import numpy as np

from ..errors import FormatError, check_rate
from ..files import atomic_write, check_replaceable, check_writable
from ..frames import in_chunks
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
MAX_USDA = 1_000_000_000
"""Largest `.usda` in memory [bytes], where all of it is until it is written."""
_USDA_BYTES = 24
# What a vertex takes in a frame at least [bytes].
_VERTEX_BYTES = {".obj": 20, ".npz": 9, ".pc2": 12, ".mdd": 12, ".glb": 12, ".html": 12}
_VERTEX_BYTES |= {".usdc": 12, ".usd": 12, ".usda": 20}


def check_output(
    path: str | pathlib.Path, frames: int | None = None, vertices: int = 0
) -> pathlib.Path:
    """Checks that a clip can be written to a path, before minutes are spent on computing it.

    Args:
        path: Output path.
        frames: Number of frames, if known.
        vertices: Vertices whose positions are written, as far as they are known.

    Returns:
        The path.

    Raises:
        FormatError: The extension is unknown (the message lists the known ones), there are too
            many frames, or the path isn't writable, is read-only or an input.
        DiskFullError: Less is free than the clip needs.
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
        check_gltf(path, frames, vertices)
    if path.suffix.lower() == ".usda" and _USDA_BYTES * vertices * (frames or 0) > MAX_USDA:
        raise FormatError(
            f"{path}: {frames} frames of {vertices} vertices are too many for text: write .usdc."
        )
    check_writable(path, _VERTEX_BYTES[path.suffix.lower()] * vertices * (frames or 0))
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
    A number is added to names that several meshes have.

    Args:
        path: Output path; its extension selects the format.
        meshes: Meshes to write [m], Y up, all with the same number of frames.
        fps: Frames per second.
        velocities: USD: write velocities too, for motion blur.

    Returns:
        The files written.

    Raises:
        FormatError: The extension is unknown, there are too many frames for glTF, or meshes have
            different numbers of frames or none.
        PhysXNetError: ``fps`` isn't a positive number.
        DiskFullError: It doesn't fit on the disk.
        MissingDependencyError: A library that the format needs isn't installed.
    """
    suffix = pathlib.Path(path).suffix.lower()
    if not meshes or len({len(m.positions) for m in meshes}) > 1 or not len(meshes[0].positions):
        counts = [len(m.positions) for m in meshes]
        raise FormatError(f"{path}: meshes of {counts} frames, expected the same number.")
    check_rate(fps)
    meshes = _named_apart(meshes)
    # In USD a skinned body has no positions.
    moving = [m for m in meshes if not (suffix.startswith(".usd") and m.skinning is not None)]
    frames = len(meshes[0].positions)
    path = check_output(path, frames, sum(m.positions.shape[1] for m in moving))
    if suffix.startswith(".usd"):
        return write_usd(path, meshes, fps, velocities=velocities)
    if suffix == ".npz":
        _write_npz(path, meshes, fps)
        return [path]
    if suffix in (".glb", ".html"):
        write = write_gltf if suffix == ".glb" else write_html
        write(path, meshes, fps)
        return [path]
    # Files left by a longer clip would be taken for the rest of this one.
    left = [p for m in meshes for p in _left(path, m)] if suffix == ".obj" else []
    for p in left:
        check_replaceable(p)
    written: list[pathlib.Path] = []
    with contextlib.ExitStack() as stack:
        # All files appear at the end, or none.
        for m in meshes:
            written += _write_parts(path, suffix, m, fps, stack)
    for p in left:
        p.unlink()
    return written


def _named_apart(meshes: Sequence[AnimatedMesh]) -> list[AnimatedMesh]:
    """The meshes; those whose names give the same file names have a number too."""
    out: list[AnimatedMesh] = []
    taken: set[str] = set()
    for m in meshes:
        same = (f"{m.name}_{k}" for k in itertools.count(2))
        name = next(n for n in itertools.chain([m.name], same) if _file_name(n) not in taken)
        taken.add(_file_name(name))
        out.append(m if name == m.name else dataclasses.replace(m, name=name))
    return out


def _left(path: pathlib.Path, m: AnimatedMesh) -> Iterator[pathlib.Path]:
    """Files of a mesh's frames after its last."""
    for k in itertools.count(len(m.positions)):
        p = path.with_name(f"{_stem(path, m)}_{k:04d}.obj")
        if not p.is_file():
            return
        yield p


def _write_npz(path: pathlib.Path, meshes: Sequence[AnimatedMesh], fps: float) -> None:
    """Writes an archive of arrays, positions by chunks."""
    with (
        atomic_write(path) as part,
        zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED, allowZip64=True) as archive,
    ):

        def add(name: str, x: np.ndarray) -> None:
            # A date of its own, so that equal clips are equal files.
            entry = zipfile.ZipInfo(f"{name}.npy")
            entry.compress_type = zipfile.ZIP_DEFLATED
            with archive.open(entry, "w", force_zip64=True) as file:
                descr = np.lib.format.dtype_to_descr(x.dtype)
                header = {"descr": descr, "fortran_order": False, "shape": x.shape}
                np.lib.format.write_array_header_1_0(file, header)
                for rows in in_chunks(x) if x.ndim == 3 else [x]:
                    file.write(np.ascontiguousarray(rows).data)

        add("fps", np.asarray(fps))
        for m in meshes:
            add(f"{m.name}_positions", m.positions)
            add(f"{m.name}_faces", m.faces)


def _stem(path: pathlib.Path, mesh: AnimatedMesh) -> str:
    return f"{path.stem}_{_file_name(mesh.name)}"


def _file_name(name: str) -> str:
    return _INVALID.sub("_", name)


def _write_parts(
    path: pathlib.Path, suffix: str, m: AnimatedMesh, fps: float, stack: contextlib.ExitStack
) -> list[pathlib.Path]:
    """Writes a mesh as OBJ files or as a cache with one, to be put in place with the stack."""
    stem = _stem(path, m)
    drawn, library, written = m.polygons, None, []
    if drawn is not None and drawn.materials:
        library = f"{stem}.mtl"
        written += write_materials(path.with_name(library), drawn.materials)

    def part(name: str) -> pathlib.Path:
        written.append(path.with_name(name))
        return stack.enter_context(atomic_write(written[-1]))

    cached = suffix != ".obj"
    if suffix == ".mdd":
        write_mdd(part(f"{stem}{suffix}"), m.positions, fps)
    elif cached:
        write_pc2(part(f"{stem}{suffix}"), m.positions)
    shown = m.positions[:1] if cached else m.positions
    for k, x in enumerate(itertools.chain.from_iterable(in_chunks(shown))):
        name = f"{stem}.obj" if cached else f"{stem}_{k:04d}.obj"
        write_obj(part(name), x, m.faces, m.uv, m.uv_faces, polygons=drawn, library=library)
    return written
