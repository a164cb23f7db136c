# pyright: reportAttributeAccessIssue=false
"""USD: constant topology, time samples, metres, Y up."""

import pathlib
import re
from collections.abc import Sequence

import numpy as np

from ..errors import MissingDependencyError
from ..files import whole_file
from ._clip import AnimatedMesh, smooth_normals, vertex_velocities


def write_usd(path: str | pathlib.Path, meshes: Sequence[AnimatedMesh], fps: float) -> None:
    """Writes meshes as one animated stage.

    Each mesh is a prim under ``/Person`` with points, normals, velocities and extent
    as time samples (frame 0 first), ``st`` texture coordinates, no subdivision, and a
    preview material of its colour. The stage's up axis is Y, its unit the metre, its
    rate ``fps``.

    Args:
        path: ``.usdc``, ``.usd`` or ``.usda``; written whole or not at all.
        meshes: What to write; all of the same number of frames.
        fps: Frames a second.

    Raises:
        MissingDependencyError: Without usd-core.
    """
    check_usd()
    with whole_file(path) as part:
        _write(part, meshes, fps)


def check_usd() -> None:
    """Fails where usd-core is missing."""
    try:
        import pxr  # noqa: F401
    except ImportError as error:
        raise MissingDependencyError(
            "Writing USD needs usd-core: pip install 'physxnet-jax[usd]'."
        ) from error


def _write(part: pathlib.Path, meshes: Sequence[AnimatedMesh], fps: float) -> None:
    from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, Vt

    stage = Usd.Stage.CreateNew(str(part))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetTimeCodesPerSecond(fps)
    stage.SetFramesPerSecond(fps)
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(len(meshes[0].positions) - 1)
    root = UsdGeom.Xform.Define(stage, "/Person")
    stage.SetDefaultPrim(root.GetPrim())

    def vectors(x: np.ndarray) -> "Vt.Vec3fArray":
        return Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(x, dtype=np.float32))

    taken: set[str] = set()
    for m in meshes:
        name = _prim_name(m.name, taken)
        prim = UsdGeom.Mesh.Define(stage, f"/Person/{name}")
        prim.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(m.faces), 3, np.int32)))
        prim.CreateFaceVertexIndicesAttr(
            Vt.IntArray.FromNumpy(np.ascontiguousarray(m.faces.reshape(-1), dtype=np.int32))
        )
        prim.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        prim.CreateDoubleSidedAttr(True)
        points, extent = prim.CreatePointsAttr(), prim.CreateExtentAttr()
        normals, velocities = prim.CreateNormalsAttr(), prim.CreateVelocitiesAttr()
        prim.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
        smooth = smooth_normals(m.positions, m.faces)
        speed = vertex_velocities(m.positions, fps)
        for k, x in enumerate(m.positions):
            points.Set(vectors(x), k)
            normals.Set(vectors(smooth[k]), k)
            velocities.Set(vectors(speed[k]), k)
            extent.Set(vectors(np.stack([x.min(axis=0), x.max(axis=0)])), k)
        if m.uv is not None and m.uv_faces is not None:
            st = UsdGeom.PrimvarsAPI(prim).CreatePrimvar(
                "st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.faceVarying
            )
            st.Set(Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(m.uv, dtype=np.float32)))
            st.SetIndices(
                Vt.IntArray.FromNumpy(np.ascontiguousarray(m.uv_faces.reshape(-1), dtype=np.int32))
            )
        prim.CreateDisplayColorAttr(vectors(np.asarray([m.colour])))
        material = UsdShade.Material.Define(stage, f"/Person/Looks/{name}")
        shader = UsdShade.Shader.Define(stage, f"/Person/Looks/{name}/surface")
        shader.CreateIdAttr("UsdPreviewSurface")
        shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).Set(
            Gf.Vec3f(*(float(c) for c in m.colour))
        )
        shader.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(0.8)
        material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
        UsdShade.MaterialBindingAPI.Apply(prim.GetPrim()).Bind(material)
    stage.GetRootLayer().Save()
    del stage


def _prim_name(name: str, taken: set[str]) -> str:
    """A name that USD accepts and no other mesh has."""
    safe = re.sub(r"[^A-Za-z0-9_]", "_", name) or "mesh"
    safe = f"_{safe}" if safe[0].isdigit() else safe
    while safe in taken or safe == "Looks":
        safe += "_"
    taken.add(safe)
    return safe
