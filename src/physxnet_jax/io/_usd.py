# pyright: reportAttributeAccessIssue=false
"""USD: constant topology, time samples, metres, Y up."""

import pathlib
import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..errors import MissingDependencyError
from ..files import whole_file
from ._clip import AnimatedMesh, smooth_normals, vertex_velocities


def write_usd(path: str | pathlib.Path, meshes: Sequence[AnimatedMesh], fps: float) -> None:
    """Writes meshes as one animated stage.

    Each mesh is a prim under ``/Person`` with points, normals, velocities and extent
    as time samples (frame 0 first), ``st`` texture coordinates and no subdivision. Polygons
    and materials are those of the mesh, a subset of faces for each of several; a mesh
    without any has a preview material of its colour. The stage's up axis is Y, its unit the
    metre, its rate ``fps``.

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
    from pxr import Sdf, Usd, UsdGeom, UsdShade, Vt

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

    def numbers(x: np.ndarray) -> "Vt.IntArray":
        return Vt.IntArray.FromNumpy(np.ascontiguousarray(x.reshape(-1), dtype=np.int32))

    taken: set[str] = set()
    looks = _Looks(stage)
    for m in meshes:
        name = _prim_name(m.name, taken)
        prim = UsdGeom.Mesh.Define(stage, f"/Person/{name}")
        drawn = m.polygons
        counts = np.full(len(m.faces), 3) if drawn is None else drawn.counts
        prim.CreateFaceVertexCountsAttr(numbers(counts))
        prim.CreateFaceVertexIndicesAttr(numbers(m.faces if drawn is None else drawn.corners))
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
            rows = None if drawn is None else drawn.uv_corners
            st.SetIndices(numbers(m.uv_faces if rows is None else rows))
        prim.CreateDisplayColorAttr(vectors(np.asarray([m.colour])))
        binding = UsdShade.MaterialBindingAPI.Apply(prim.GetPrim())
        parts: set[str] = set()
        for called, colour, chosen in m.looks:
            if len(chosen) == len(m.faces):
                binding.Bind(looks.material(called, colour))
                continue
            own = drawn.of_triangle[chosen] if drawn is not None else chosen
            subset = binding.CreateMaterialBindSubset(
                _prim_name(called, parts), numbers(np.unique(own))
            )
            UsdShade.MaterialBindingAPI.Apply(subset.GetPrim()).Bind(looks.material(called, colour))
    stage.GetRootLayer().Save()


class _Looks:
    """Preview materials of a stage, one for each name and colour."""

    def __init__(self, stage: Any) -> None:
        self.stage = stage
        self.made: dict[tuple[str, tuple[float, float, float]], Any] = {}
        self.taken: set[str] = set()

    def material(self, name: str, colour: tuple[float, float, float]) -> Any:
        from pxr import Gf, Sdf, UsdShade

        if (name, colour) not in self.made:
            path = f"/Person/Looks/{_prim_name(name, self.taken)}"
            material = UsdShade.Material.Define(self.stage, path)
            shader = UsdShade.Shader.Define(self.stage, f"{path}/surface")
            shader.CreateIdAttr("UsdPreviewSurface")
            told = shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f)
            told.Set(Gf.Vec3f(*(float(c) for c in colour)))
            shader.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(0.8)
            material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
            self.made[name, colour] = material
        return self.made[name, colour]


def _prim_name(name: str, taken: set[str]) -> str:
    """A name that USD accepts and no other mesh has."""
    safe = re.sub(r"[^A-Za-z0-9_]", "_", name) or "mesh"
    safe = f"_{safe}" if safe[0].isdigit() else safe
    while safe in taken or safe == "Looks":
        safe += "_"
    taken.add(safe)
    return safe
