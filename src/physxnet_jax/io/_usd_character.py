# pyright: reportAttributeAccessIssue=false
"""Meshes of a USD stage over time: points as time samples, or a skin of UsdSkel."""

import pathlib

import numpy as np

from ..errors import FormatError, MissingDependencyError
from ._character import Moving

# Coordinates and frames that are read at most.
_MOST, _FRAMES = 3e8, 20_000


def read_usd_meshes(
    path: pathlib.Path, fps: float
) -> tuple[list[Moving], float | None, str | None]:
    """Every mesh of a stage, in world space.

    Args:
        path: The stage.
        fps: Not used: a stage has a rate of its own.

    Returns:
        The meshes in metres, their rate, and the axis that is up, if it is said.

    Raises:
        FormatError: Damaged, or too long.
        MissingDependencyError: Without usd-core.
    """
    try:
        from pxr import Tf
    except ImportError as error:
        raise MissingDependencyError(
            "Reading USD needs usd-core: pip install 'physxnet-jax[usd]'."
        ) from error
    try:
        return _read(path)
    # What the file quotes in an error needn't be text.
    except (Tf.ErrorException, UnicodeDecodeError, TypeError, ValueError) as error:
        if isinstance(error, FormatError):
            raise
        raise FormatError(f"{path}: not a USD stage, or a damaged one. Export it again.") from None


def _read(path: pathlib.Path) -> tuple[list[Moving], float | None, str | None]:
    from pxr import Usd, UsdGeom, UsdSkel

    stage = Usd.Stage.Open(str(path))
    folder = path.parent.resolve()
    for layer in stage.GetUsedLayers():
        if layer.realPath and not pathlib.Path(layer.realPath).resolve().is_relative_to(folder):
            raise FormatError(
                f"{path}: it refers to '{layer.identifier[:80]}' outside its folder. Put that"
                " beside it, or flatten the stage."
            )
    start, end = stage.GetStartTimeCode(), stage.GetEndTimeCode()
    rate = stage.GetTimeCodesPerSecond() or 24.0
    if not (np.isfinite([start, end, rate]).all() and 0 <= end - start < _FRAMES and rate > 0):
        raise FormatError(
            f"{path}: runs from {start} to {end} at {rate} a second, not a"
            f" clip of up to {_FRAMES:,} frames. Set the range of the clip and export again."
        )
    if stage.HasAuthoredTimeCodeRange():
        UsdSkel.BakeSkinning(Usd.PrimRange(stage.GetPseudoRoot()))
    codes = start + np.arange(int(end - start) + 1)
    # Unsaid it would mean centimetres, which files in metres don't say either.
    said = UsdGeom.StageHasAuthoredMetersPerUnit(stage)
    unit = UsdGeom.GetStageMetersPerUnit(stage) if said else 1.0
    parts, points = [], 0
    for prim in Usd.PrimRange(stage.GetPseudoRoot(), Usd.TraverseInstanceProxies()):
        if not prim.IsA(UsdGeom.Mesh):
            continue
        mesh = UsdGeom.Mesh(prim)
        first = mesh.GetPointsAttr().Get(start)
        counts, corners = (
            mesh.GetFaceVertexCountsAttr().Get(),
            mesh.GetFaceVertexIndicesAttr().Get(),
        )
        if not first or not counts or not corners:
            continue
        faces = _triangles(np.asarray(counts), np.asarray(corners))
        if len(faces) == 0 or faces.min() < 0 or faces.max() >= len(first):
            raise FormatError(f"{path}: faces of {prim.GetPath()} don't fit its points.")
        if mesh.GetOrientationAttr().Get() == UsdGeom.Tokens.leftHanded:
            faces = np.ascontiguousarray(faces[:, ::-1])
        points += len(first)
        if len(codes) * points * 3.0 > _MOST:
            raise FormatError(f"{path}: {len(codes)} frames of {points:,} points. Cut the clip.")
        x = np.zeros((len(codes), len(first), 3), np.float32)
        for k, code in enumerate(codes):
            local = np.asarray(mesh.GetPointsAttr().Get(code), float)
            if local.shape != x.shape[1:]:
                raise FormatError(f"{path}: {prim.GetPath()} changes its number of points.")
            world = np.asarray(UsdGeom.XformCache(code).GetLocalToWorldTransform(prim))
            x[k] = unit * (local @ world[:3, :3] + world[3, :3])
        parts.append(Moving(prim.GetName(), x, faces))
    moving = [p for p in parts if np.ptp(p.positions, axis=0).max() > 0] or parts
    up = str(UsdGeom.GetStageUpAxis(stage)) if stage.HasAuthoredMetadata("upAxis") else None
    return moving, float(rate), up


def _triangles(counts: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Polygons as fans."""
    if counts.min() < 0 or counts.sum() != len(corners):
        return np.zeros((0, 3), np.int32)
    starts = np.cumsum(counts) - counts
    rows = [
        np.stack([corners[s], corners[s + k], corners[s + k + 1]], axis=1)
        for n in np.unique(counts)
        for s in (starts[counts == n],)
        for k in range(1, n - 1)
    ]
    return np.concatenate(rows).astype(np.int32) if rows else np.zeros((0, 3), np.int32)
