"""Garments that stand still, from every format they come in."""

import dataclasses
import pathlib
from collections.abc import Sequence

import numpy as np

from ..errors import FormatError
from ..files import is_file
from ._clip import StillMesh
from ._moving import Moving, joined, named, welded
from ._obj import read_obj

GARMENT_FORMATS = (".obj", ".glb", ".gltf", ".usdc", ".usd", ".usda", ".ply", ".stl")
"""Endings that `read_mesh` knows."""

_MAX_BYTES = 500_000_000
# Beyond that their squares aren't finite in float32.
_FARTHEST = 1e18


def mesh_name(path: str | pathlib.Path) -> str:
    """What a mesh of a file is called: ``coat``, or ``coat_sleeves`` for one of several."""
    file, part = split_part(path)
    return file.stem if part is None else f"{file.stem}_{part}"


def read_mesh(path: str | pathlib.Path) -> StillMesh:
    """A mesh as its file has it, in the file's unit and axes, triangulated.

    A rigged mesh of glTF or USD is read as it was bound, an animated one as it begins.
    Vertices that these formats, and STL, double at seams become one. Several meshes
    become one, but for ``coat.glb#sleeves``, which takes the mesh ``sleeves`` alone.

    Args:
        path: An ``.obj``, ``.glb``, ``.gltf``, ``.usd``, ``.usda``, ``.usdc``, ``.ply`` or
            ``.stl``.

    Raises:
        FormatError: No such format or mesh, a damaged file.
        MotionError: A damaged glTF.
        MissingDependencyError: Without the library that reads it.
    """
    path, part = split_part(path)
    suffix = path.suffix.lower()
    if suffix not in GARMENT_FORMATS:
        raise FormatError(
            f"{path}: no garment is read from '{suffix}', only from {', '.join(GARMENT_FORMATS)}."
            " Export the mesh as one of these (triangles or quads, with uv)."
        )
    if not is_file(path):
        raise FormatError(f"{path}: no such file. Check the path.")
    if path.stat().st_size > _MAX_BYTES:
        raise FormatError(f"{path}: over 500 MB. Decimate the mesh first.")
    if suffix == ".obj":
        return read_obj(path, part)
    if suffix in (".ply", ".stl"):
        if part is not None:
            raise FormatError(f"{path}: holds one mesh, so '#{part}' says nothing. Leave it out.")
        return _read_plain(path)
    if suffix in (".glb", ".gltf"):
        from ._gltf_character import read_gltf_still as read
    else:
        from ._usd_character import read_usd_still as read
    # What a damaged file holds may be infinite; it is refused below.
    with np.errstate(all="ignore"):
        parts = read(path)
    if not parts:
        raise FormatError(f"{path}: no mesh in it. Export the mesh with its faces.")
    return _still(path, named(path, parts, part, "Say another after the #"))


def split_part(path: str | pathlib.Path) -> tuple[pathlib.Path, str | None]:
    """The file and, after a ``#``, the mesh of it that is meant."""
    file, _, part = str(path).rpartition("#")
    if file and pathlib.Path(file).suffix.lower() in GARMENT_FORMATS:
        return pathlib.Path(file), part
    return pathlib.Path(path), None


def _read_plain(path: pathlib.Path) -> StillMesh:
    """PLY and STL, by trimesh."""
    import trimesh

    try:
        with path.open("rb") as file, np.errstate(all="ignore"):
            mesh = trimesh.load_mesh(file, file_type=path.suffix[1:].lower(), process=False)
        x, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
        uv = getattr(mesh.visual, "uv", None)
    # The library fails in as many ways as a file can be broken.
    except Exception as error:
        raise FormatError(
            f"{path}: not a mesh that can be read ({type(error).__name__}: {error})"[:300]
            + ". Export it again, cut into triangles."
        ) from error
    if x.ndim != 2 or faces.ndim != 2 or not len(faces):
        raise FormatError(f"{path}: {len(x)} vertices and {len(faces)} faces; a mesh needs both.")
    if faces.min() < 0 or faces.max() >= len(x):
        raise FormatError(f"{path}: a face names a vertex that isn't there. Export it again.")
    uv = None if uv is None or np.shape(uv) != (len(x), 2) else np.asarray(uv, np.float64)
    whole = Moving(path.stem, x[None], faces, uv, None if uv is None else faces)
    return _still(path, [whole])


def _still(path: pathlib.Path, parts: Sequence[Moving]) -> StillMesh:
    """One mesh, finite and without doubled vertices."""
    whole = joined(
        [
            dataclasses.replace(
                p, positions=p.positions if p.bind is None else p.bind[None], bind=None
            )
            for p in parts
        ]
    )
    if not (np.abs(whole.positions) < _FARTHEST).all():
        raise FormatError(f"{path}: positions that aren't finite. Export it again.")
    if whole.uv is not None and not (np.abs(whole.uv) < _FARTHEST).all():
        raise FormatError(f"{path}: texture coordinates that aren't finite. Export it again.")
    count = len(whole.faces if whole.polygons is None else whole.polygons.counts)
    whole = welded(whole)
    if not len(whole.faces):
        raise FormatError(f"{path}: all its faces are points or lines. Export it again.")
    return StillMesh(
        np.asarray(whole.positions[0], np.float64),
        whole.faces,
        whole.uv,
        whole.uv_faces,
        whole.polygons,
        count,
        tuple(sorted({p.name for p in parts})),
    )
