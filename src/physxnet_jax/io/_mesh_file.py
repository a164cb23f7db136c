"""Reads static garment meshes of all supported formats."""

import dataclasses
import pathlib
from collections.abc import Sequence

import numpy as np

from ..errors import FormatError
from ..files import add_inputs, is_file
from ._animated_mesh import StaticMesh
from ._obj import read_obj
from ._source_mesh import SourceMesh, joined, named, welded

GARMENT_FORMATS = (".obj", ".glb", ".gltf", ".usdc", ".usd", ".usda", ".usdz", ".ply", ".stl")
"""Extensions that `read_mesh` supports."""

_MAX_BYTES = 500_000_000
# Squares of larger coordinates may overflow float32.
_MAX_COORDINATE = 1e18


def mesh_name(path: str | pathlib.Path) -> str:
    """The name of a file's mesh: ``coat``, or ``coat_sleeves`` for one of several."""
    file, part = split_part(path)
    name = file.stem if part is None else f"{file.stem}_{part}"
    # What isn't UTF-8 in a file's name can't be written as text.
    return name.encode("utf-8", "replace").decode()


def read_mesh(path: str | pathlib.Path) -> StaticMesh:
    """Reads a triangulated mesh in its file's unit and axes.

    Rigged meshes of glTF and USD are read in their bind pose, animated ones at their start.
    Vertices that these formats and STL duplicate at seams are merged. Several meshes are
    joined, but ``coat.glb#sleeves`` reads the mesh ``sleeves`` alone, ``#a+b`` two of them.

    Args:
        path: An ``.obj``, ``.glb``, ``.gltf``, ``.usd``, ``.usda``, ``.usdc``, ``.usdz``,
            ``.ply`` or ``.stl``.

    Raises:
        FormatError: The format is unknown, the mesh doesn't exist, or the file is damaged.
        MotionError: A glTF is damaged.
        MissingDependencyError: The library that reads the format isn't installed.
    """
    path, part = split_part(path)
    suffix = path.suffix.lower()
    if suffix not in GARMENT_FORMATS:
        raise FormatError(
            f"{path}: '{suffix}' isn't a garment format; these are: {', '.join(GARMENT_FORMATS)}."
            " Export the mesh as one of these (triangles or quads, with uv)."
        )
    if not is_file(path):
        raise FormatError(f"{path}: no such file. Check the path.")
    add_inputs(path)
    if path.stat().st_size > _MAX_BYTES:
        raise FormatError(f"{path}: over 500 MB. Decimate the mesh first.")
    if suffix == ".obj":
        return read_obj(path, part)
    if suffix in (".ply", ".stl"):
        if part is not None:
            raise FormatError(f"{path}: holds one mesh, so '#{part}' has no meaning. Leave it out.")
        return _read_plain(path)
    # Damaged files may contain infinities, which are rejected below.
    with np.errstate(all="ignore"):
        if suffix in (".glb", ".gltf"):
            from ._gltf_mesh import read_gltf_still

            # The format prescribes both.
            parts, unit, up = read_gltf_still(path), "m", "y"
        else:
            from ._usd_mesh import read_usd_still

            parts, unit, up = read_usd_still(path)
    if not parts:
        raise FormatError(f"{path}: no mesh in it. Export the mesh with its faces.")
    mesh = _static_mesh(path, named(path, parts, part, "Choose another after the #"))
    return dataclasses.replace(mesh, unit=unit, up=up)


def split_part(path: str | pathlib.Path) -> tuple[pathlib.Path, str | None]:
    """Splits ``FILE#MESH`` into the file and the name of its mesh, None without one."""
    file, _, part = str(path).rpartition("#")
    if file and pathlib.Path(file).suffix.lower() in GARMENT_FORMATS:
        return pathlib.Path(file), part
    return pathlib.Path(path), None


def _read_plain(path: pathlib.Path) -> StaticMesh:
    """Reads PLY and STL with trimesh."""
    import trimesh

    try:
        with path.open("rb") as file, np.errstate(all="ignore"):
            mesh = trimesh.load_mesh(file, file_type=path.suffix[1:].lower(), process=False)
        x, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
        uv = getattr(mesh.visual, "uv", None)
    # trimesh raises many exception types for damaged files.
    except Exception as error:
        raise FormatError(
            f"{path}: not a mesh that can be read ({type(error).__name__}: {error})"[:300]
            + ". Export it again, triangulated."
        ) from error
    if x.ndim != 2 or faces.ndim != 2 or not len(faces):
        raise FormatError(f"{path}: {len(x)} vertices and {len(faces)} faces; a mesh needs both.")
    if faces.min() < 0 or faces.max() >= len(x):
        raise FormatError(f"{path}: a face refers to a vertex that doesn't exist. Export it again.")
    uv = None if uv is None or np.shape(uv) != (len(x), 2) else np.asarray(uv, np.float64)
    whole = SourceMesh(path.stem, x[None], faces, uv, None if uv is None else faces)
    return _static_mesh(path, [whole])


def _static_mesh(path: pathlib.Path, parts: Sequence[SourceMesh]) -> StaticMesh:
    """Joins meshes into one, checks that it is finite and merges duplicate vertices."""
    whole = joined(
        [
            dataclasses.replace(
                p, positions=p.positions if p.bind is None else p.bind[None], bind=None
            )
            for p in parts
        ]
    )
    if not (np.abs(whole.positions) < _MAX_COORDINATE).all():
        raise FormatError(f"{path}: positions that aren't finite. Export it again.")
    if whole.uv is not None and not (np.abs(whole.uv) < _MAX_COORDINATE).all():
        raise FormatError(f"{path}: texture coordinates that aren't finite. Export it again.")
    count = len(whole.faces if whole.polygons is None else whole.polygons.counts)
    whole = welded(whole)
    if not len(whole.faces):
        raise FormatError(f"{path}: all its faces are points or lines. Export it again.")
    return StaticMesh(
        np.asarray(whole.positions[0], np.float64),
        whole.faces,
        whole.uv,
        whole.uv_faces,
        whole.polygons,
        count,
        tuple(sorted({p.name for p in parts})),
    )
