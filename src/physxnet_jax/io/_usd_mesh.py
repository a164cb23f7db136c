# pyright: reportAttributeAccessIssue=false
"""Reads animated meshes of USD stages: points as time samples, or UsdSkel skins."""

import contextlib
import dataclasses
import pathlib
from collections.abc import Iterator
from typing import Any

import numpy as np
from jaxtyping import Float

from ..errors import FormatError, MissingDependencyError
from ..geometry import Material, Polygons, make_material
from ._source_mesh import SourceMesh
from ._texture import texture_beside
from ._usd_trial import try_stage
from ._uv_transform import UvTransform, make_uv_transform, transform_uvs

# Largest numbers of coordinates, frames, and frames per second between time codes.
_MOST, _FRAMES, _MOST_RATE = 3e8, 20_000, 240.0
# Time codes per second from which time codes are taken for frames.
_MIN_FRAME_RATE = 12.0


def read_usd_meshes(
    path: pathlib.Path, fps: float
) -> tuple[list[SourceMesh], float | None, str | None]:
    """Reads the meshes of a stage that move, or all if none does, in world space.

    Args:
        path: The stage.
        fps: Target frames per second: a stage with coarser time codes, such as seconds, is
            also read between them.

    Returns:
        The meshes in metres, their frame rate, and the up axis, None if undeclared.

    Raises:
        FormatError: The stage is damaged or too long.
        MissingDependencyError: usd-core isn't installed.
    """
    with _report_damage(path):
        return _read_moving(path, fps)


def read_usd_still(path: pathlib.Path) -> tuple[list[SourceMesh], str | None, str | None]:
    """Reads every mesh of a stage at its start, in world space; skins in their bind pose.

    Returns:
        The meshes, ``m`` if the stage declares its unit, and the up axis that it declares.

    Raises:
        FormatError: The stage is damaged or too large.
        MissingDependencyError: usd-core isn't installed.
    """
    with _report_damage(path):
        from pxr import UsdGeom

        stage = _open_stage(path)
        code = stage.GetStartTimeCode() if stage.HasAuthoredTimeCodeRange() else 0.0
        parts = list(_meshes(path, stage, np.array([code]), bound=True).values())
        unit = "m" if UsdGeom.StageHasAuthoredMetersPerUnit(stage) else None
        return parts, unit, _up_axis(stage)


@contextlib.contextmanager
def _report_damage(path: pathlib.Path) -> Iterator[None]:
    try:
        from pxr import Tf
    except ImportError as error:
        raise MissingDependencyError(
            "Reading USD needs usd-core: pip install 'physxnet-jax[usd]'."
        ) from error
    try:
        yield
    # Error messages may quote bytes of the file that aren't text.
    except (Tf.ErrorException, UnicodeDecodeError, TypeError, ValueError, LookupError) as error:
        if isinstance(error, FormatError):
            raise
        raise FormatError(f"{path}: not a USD stage, or a damaged one. Export it again.") from None


def _open_stage(path: pathlib.Path) -> Any:
    from pxr import Usd

    try_stage(path)
    stage = Usd.Stage.Open(str(path))
    folder = path.parent.resolve()
    for layer in stage.GetUsedLayers():
        if layer.realPath and not pathlib.Path(layer.realPath).resolve().is_relative_to(folder):
            raise FormatError(
                f"{path}: it refers to '{layer.identifier[:80]}' outside its folder. Put that"
                " beside it, or flatten the stage."
            )
    return stage


def _time_codes(stage: Any) -> tuple[float, float] | None:
    """First and last time code of a stage: as authored, else of its time samples; or None."""
    if stage.HasAuthoredTimeCodeRange():
        return stage.GetStartTimeCode(), stage.GetEndTimeCode()
    times = [
        t
        for prim in stage.TraverseAll()
        for attribute in prim.GetAttributes()
        if attribute.ValueMightBeTimeVarying()
        for t in attribute.GetTimeSamples()
    ]
    return (min(times), max(times)) if times else None


def _read_moving(
    path: pathlib.Path, fps: float
) -> tuple[list[SourceMesh], float | None, str | None]:
    from pxr import Usd, UsdGeom, UsdSkel

    stage = _open_stage(path)
    span = _time_codes(stage)
    start, end = (0.0, 0.0) if span is None else span
    rate = stage.GetTimeCodesPerSecond() or 24.0
    if not (np.isfinite([start, end, rate]).all() and 0 <= end - start < _FRAMES and rate >= 1e-3):
        raise FormatError(
            f"{path}: runs from {start} to {end} at {rate} per second, not a"
            f" clip of up to {_FRAMES:,} frames. Set the range of the clip and export again."
        )
    # Time codes that are frames aren't subdivided.
    subdivisions = 1 if rate >= _MIN_FRAME_RATE else int(np.ceil(min(fps, _MOST_RATE) / rate))
    codes = start + np.arange(int((end - start) * subdivisions + 1e-6) + 1) / subdivisions
    if len(codes) > _FRAMES:
        raise FormatError(f"{path}: {(end - start) / rate:.0f} s are too long. Cut the clip.")
    if span is not None:
        # BakeSkinning writes the points of every frame into the stage.
        meshes = [UsdGeom.Mesh(p) for p in stage.Traverse() if p.IsA(UsdGeom.Mesh)]
        points = sum(len(m.GetPointsAttr().Get(start) or ()) for m in meshes)
        if len(codes) * points * 3.0 > _MOST:
            raise FormatError(f"{path}: {len(codes)} frames of {points:,} points. Cut the clip.")
        binds = _bind_poses(path, stage, start)
        UsdSkel.BakeSkinning(Usd.PrimRange(stage.GetPseudoRoot()))
    else:
        binds = {}
    parts = [
        dataclasses.replace(part, bind=binds.get(prim_path))
        for prim_path, part in _meshes(path, stage, codes, bound=False).items()
    ]
    moving = [p for p in parts if np.ptp(p.positions, axis=0).max() > 0] or parts
    up = _up_axis(stage)
    return moving, float(rate * subdivisions), None if up is None else up.upper()


def _up_axis(stage: Any) -> str | None:
    """The up axis that a stage declares, ``y`` or ``z``."""
    from pxr import UsdGeom

    if not stage.HasAuthoredMetadata("upAxis"):
        return None
    return str(UsdGeom.GetStageUpAxis(stage)).lower()


def _bind_poses(
    path: pathlib.Path, stage: Any, code: float
) -> dict[str, Float[np.ndarray, "vertices 3"]]:
    """Bind poses of skins by the path of their mesh."""
    from pxr import UsdSkel

    return {
        prim_path: part.positions[0]
        for prim_path, part in _meshes(path, stage, np.array([code]), bound=True).items()
        if UsdSkel.BindingAPI(stage.GetPrimAtPath(prim_path)).GetJointIndicesPrimvar().HasValue()
    }


def _meshes(
    path: pathlib.Path, stage: Any, codes: Float[np.ndarray, " frames"], *, bound: bool
) -> dict[str, SourceMesh]:
    """Meshes at these times by their path [m]; skins in their bind pose if ``bound``."""
    from pxr import Usd, UsdGeom, UsdSkel

    # USD's default unit is the centimetre, but files in metres omit the unit as well.
    authored = UsdGeom.StageHasAuthoredMetersPerUnit(stage)
    unit = UsdGeom.GetStageMetersPerUnit(stage) if authored else 1.0
    parts: dict[str, SourceMesh] = {}
    points = 0
    for prim in Usd.PrimRange(stage.GetPseudoRoot(), Usd.TraverseInstanceProxies()):
        if not prim.IsA(UsdGeom.Mesh):
            continue
        mesh = UsdGeom.Mesh(prim)
        first = mesh.GetPointsAttr().Get(codes[0])
        counts, corners = (
            mesh.GetFaceVertexCountsAttr().Get(),
            mesh.GetFaceVertexIndicesAttr().Get(),
        )
        if not first or not counts or not corners:
            continue
        slots = _triangles(np.asarray(counts), len(corners))
        faces = np.asarray(corners)[slots]
        if len(faces) == 0 or faces.min() < 0 or faces.max() >= len(first):
            raise FormatError(f"{path}: faces of {prim.GetPath()} don't fit its points.")
        if mesh.GetOrientationAttr().Get() == UsdGeom.Tokens.leftHanded:
            slots = np.ascontiguousarray(slots[:, ::-1])
            faces = np.asarray(corners)[slots]
        points += len(first)
        if len(codes) * points * 3.0 > _MOST:
            raise FormatError(f"{path}: {len(codes)} frames of {points:,} points. Cut the clip.")
        x = np.zeros((len(codes), len(first), 3), np.float32)
        mirrored = False
        for k, code in enumerate(codes):
            local = np.asarray(mesh.GetPointsAttr().Get(code), float)
            if local.shape != x.shape[1:]:
                raise FormatError(f"{path}: {prim.GetPath()} changes its number of points.")
            world = np.asarray(UsdGeom.XformCache(code).GetLocalToWorldTransform(prim))
            skin = UsdSkel.BindingAPI(prim).GetGeomBindTransformAttr()
            if bound and skin.HasAuthoredValue():
                world = np.asarray(skin.Get(), float)
                if world.shape != (4, 4):
                    raise FormatError(f"{path}: {prim.GetPath()} has no 4x4 bind matrix.")
            mirrored = mirrored or (k == 0 and np.linalg.det(world[:3, :3]) < 0)
            x[k] = unit * (local @ world[:3, :3] + world[3, :3])
        uv, rows = _uv_transform(prim, np.asarray(corners))
        drawn, moves = None, {}
        if bound:
            drawn, moves = _polygons(path, prim, np.asarray(counts), np.asarray(corners), rows)
        uv_faces = None if rows is None else rows[slots]
        if drawn is not None and uv is not None and uv_faces is not None:
            uv, uv_faces, drawn = transform_uvs(uv, uv_faces, drawn, moves)
        part = SourceMesh(prim.GetName(), x, faces, uv, uv_faces, polygons=drawn)
        parts[str(prim.GetPath())] = part.reversed() if mirrored else part
    return parts


def _polygons(
    path: pathlib.Path, prim: Any, counts: np.ndarray, corners: np.ndarray, rows: np.ndarray | None
) -> tuple[Polygons, dict[int, UvTransform]]:
    """Polygons of a prim, facing outwards, with the materials of the prim and its subsets.

    Also returns the transforms of texture coordinates, by index of the material.
    """
    from pxr import UsdGeom, UsdShade

    found: list[tuple[Material, bytes]] = []
    moves: dict[int, UvTransform] = {}

    def number(at: Any) -> int:
        bound = UsdShade.MaterialBindingAPI(at).ComputeBoundMaterial()[0]
        if not bound:
            return -1
        surface = bound.ComputeSurfaceSource()[0]
        attribute = surface.GetInput("diffuseColor") if surface else None
        image = _image(attribute) if attribute else None
        colour, move = attribute.Get() if attribute else None, None
        if image is not None:
            colour, image, move = image[0], texture_beside(path, image[1]), image[2]
        material = make_material(bound.GetPrim().GetName(), colour, image)
        key = material, b"" if move is None else move.tobytes()
        if key not in found:
            found.append(key)
            if move is not None:
                moves[len(found) - 1] = move
        return found.index(key)

    which = np.full(len(counts), number(prim), np.int32)
    for subset in UsdShade.MaterialBindingAPI(prim).GetMaterialBindSubsets():
        chosen = np.asarray(subset.GetIndicesAttr().Get() or (), np.int64)
        which[chosen[(chosen >= 0) & (chosen < len(which))]] = number(subset.GetPrim())
    drawn = Polygons(
        counts.astype(np.int32), corners.astype(np.int32), rows, which, tuple(m for m, _ in found)
    ).chosen(np.flatnonzero(counts > 2))
    turned = UsdGeom.Mesh(prim).GetOrientationAttr().Get() == UsdGeom.Tokens.leftHanded
    return drawn.reversed(np.arange(len(drawn.counts))) if turned else drawn, moves


def _image(attribute: Any) -> tuple[object, str, UvTransform | None] | None:
    """Tint, file and UV transform of the image that an input is connected to; else None."""
    shader = _connected(attribute)
    file = shader.GetInput("file") if shader else None
    asset = file.Get() if file else None
    # UDIM tiles are several images.
    if not shader or not asset or "<UDIM>" in asset.path:
        return None
    tint = shader.GetInput("scale")
    scale = tint.Get() if tint else None
    prim_path = _connected(shader.GetInput("st"))
    move = None
    if prim_path and prim_path.GetIdAttr().Get() == "UsdTransform2d":
        scaled, moved, turned = (
            i.Get() if (i := prim_path.GetInput(name)) else None
            for name in ("scale", "translation", "rotation")
        )
        move = make_uv_transform(
            (1.0, 1.0) if scaled is None else scaled,
            (0.0, 0.0) if moved is None else moved,
            np.radians(0.0 if turned is None else turned),
        )
    return (1.0, 1.0, 1.0) if scale is None else [*scale][:3], asset.path, move


def _connected(attribute: Any) -> Any:
    """The shader that an input is connected to, or None."""
    from pxr import UsdShade

    source, *_ = (attribute and UsdShade.ConnectableAPI.GetConnectedSource(attribute)) or (None,)
    return UsdShade.Shader(source.GetPrim()) if source else None


def _uv_transform(prim: Any, vertices: np.ndarray) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Texture coordinates `st`, or the only set, and each corner's row; None if they don't fit."""
    from pxr import Sdf, UsdGeom

    primvars = UsdGeom.PrimvarsAPI(prim)
    st = primvars.GetPrimvar("st")
    if not st or not st.HasValue():
        kinds = (Sdf.ValueTypeNames.TexCoord2fArray, Sdf.ValueTypeNames.TexCoord2dArray)
        sets = [p for p in primvars.GetPrimvarsWithValues() if p.GetTypeName() in kinds]
        # Choosing among several other sets would be a guess.
        st = sets[0] if len(sets) == 1 else st
    uv = np.asarray(st.Get() or (), float) if st and st.HasValue() else np.zeros(0)
    if uv.ndim != 2 or uv.shape[1] != 2:
        return None, None
    each = st.GetInterpolation()
    if each not in (UsdGeom.Tokens.faceVarying, UsdGeom.Tokens.vertex, UsdGeom.Tokens.varying):
        return None, None
    corners = np.arange(len(vertices)) if each == UsdGeom.Tokens.faceVarying else vertices
    if st.IsIndexed():
        index = np.asarray(st.GetIndices(), np.int64)
        if corners.max() >= len(index):
            return None, None
        corners = index[corners]
    if corners.min() < 0 or corners.max() >= len(uv):
        return None, None
    return uv, corners.astype(np.int32)


def _triangles(counts: np.ndarray, corners: int) -> np.ndarray:
    """Splits polygons into fans of corner rows, polygon after polygon."""
    if counts.min() < 0 or counts.sum() != corners:
        return np.zeros((0, 3), np.int32)
    starts = np.cumsum(counts) - counts
    rows = [
        np.stack([s, s + k, s + k + 1], axis=1)
        for n in np.unique(counts)
        for s in (starts[counts == n],)
        for k in range(1, n - 1)
    ]
    if not rows:
        return np.zeros((0, 3), np.int32)
    found = np.concatenate(rows)
    return found[np.argsort(found[:, 0], kind="stable")].astype(np.int32)
