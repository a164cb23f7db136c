# pyright: reportAttributeAccessIssue=false
"""Writes USD: constant topology, time samples, metres, Y up."""

import pathlib
import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..errors import MissingDependencyError
from ..files import atomic_write
from ..geometry import Texture
from ._animated_mesh import AnimatedMesh, Look, smooth_normals, vertex_velocities
from ._texture import write_textures


def write_usd(
    path: str | pathlib.Path, meshes: Sequence[AnimatedMesh], fps: float
) -> list[pathlib.Path]:
    """Writes meshes as one animated stage.

    Each mesh is a prim under ``/Person`` with points, normals, velocities and extent
    as time samples (frame 0 first), ``st`` texture coordinates and no subdivision. It has the
    polygons and materials of the mesh; several materials are bound to subsets of faces, and
    images are written beside the stage. A mesh without materials has a preview material of its
    colour. The stage's up axis is Y, its unit is the metre and its rate is ``fps``.

    Args:
        path: ``.usdc``, ``.usd`` or ``.usda``; written atomically.
        meshes: Meshes to write, all with the same number of frames.
        fps: Frames per second.

    Returns:
        The files written.

    Raises:
        MissingDependencyError: usd-core isn't installed.
    """
    check_usd()
    path = pathlib.Path(path)
    images = write_textures(path, [look.texture for m in meshes for look in m.looks])
    with atomic_write(path) as part:
        _write(part, meshes, fps, {t: image.name for t, image in images.items()})
    return [path, *images.values()]


def check_usd() -> None:
    """Raises an error if usd-core isn't installed."""
    try:
        import pxr  # noqa: F401
    except ImportError as error:
        raise MissingDependencyError(
            "Writing USD needs usd-core: pip install 'physxnet-jax[usd]'."
        ) from error


def _write(
    part: pathlib.Path, meshes: Sequence[AnimatedMesh], fps: float, images: dict[Texture, str]
) -> None:
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
    looks = _Looks(stage, images)
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
        for look in m.looks:
            if len(look.faces) == len(m.faces):
                binding.Bind(looks.material(look))
                continue
            own = drawn.of_triangle[look.faces] if drawn is not None else look.faces
            subset = binding.CreateMaterialBindSubset(
                _prim_name(look.name, parts), numbers(np.unique(own))
            )
            UsdShade.MaterialBindingAPI.Apply(subset.GetPrim()).Bind(looks.material(look))
    stage.GetRootLayer().Save()


class _Looks:
    """Preview materials of a stage, one for each name, colour and image."""

    def __init__(self, stage: Any, images: dict[Texture, str]) -> None:
        self.stage = stage
        self.images = images
        self.made: dict[tuple[object, ...], Any] = {}
        self.taken: set[str] = set()

    def material(self, look: Look) -> Any:
        from pxr import Gf, Sdf, UsdShade

        key = look.name, look.colour, look.texture
        if key not in self.made:
            path = f"/Person/Looks/{_prim_name(look.name, self.taken)}"
            material = UsdShade.Material.Define(self.stage, path)
            shader = UsdShade.Shader.Define(self.stage, f"{path}/surface")
            shader.CreateIdAttr("UsdPreviewSurface")
            diffuse = shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f)
            if look.texture is None:
                diffuse.Set(Gf.Vec3f(*(float(c) for c in look.colour)))
            else:
                diffuse.ConnectToSource(self._image(path, look).ConnectableAPI(), "rgb")
            shader.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(0.8)
            material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
            self.made[key] = material
        return self.made[key]

    def _image(self, path: str, look: Look) -> Any:
        """A shader that reads the image at the mesh's texture coordinates."""
        from pxr import Gf, Sdf, UsdShade

        at = UsdShade.Shader.Define(self.stage, f"{path}/coordinates")
        at.CreateIdAttr("UsdPrimvarReader_float2")
        at.CreateInput("varname", Sdf.ValueTypeNames.String).Set("st")
        image = UsdShade.Shader.Define(self.stage, f"{path}/image")
        image.CreateIdAttr("UsdUVTexture")
        assert look.texture is not None
        file = f"./{self.images[look.texture]}"
        image.CreateInput("file", Sdf.ValueTypeNames.Asset).Set(Sdf.AssetPath(file))
        image.CreateInput("sourceColorSpace", Sdf.ValueTypeNames.Token).Set("sRGB")
        for side in ("wrapS", "wrapT"):
            image.CreateInput(side, Sdf.ValueTypeNames.Token).Set("repeat")
        tint = Gf.Vec4f(*(float(c) for c in look.colour), 1.0)
        image.CreateInput("scale", Sdf.ValueTypeNames.Float4).Set(tint)
        at.CreateOutput("result", Sdf.ValueTypeNames.Float2)
        image.CreateInput("st", Sdf.ValueTypeNames.Float2).ConnectToSource(
            at.ConnectableAPI(), "result"
        )
        image.CreateOutput("rgb", Sdf.ValueTypeNames.Float3)
        return image


def _prim_name(name: str, taken: set[str]) -> str:
    """A valid USD name that isn't taken."""
    safe = re.sub(r"[^A-Za-z0-9_]", "_", name) or "mesh"
    safe = f"_{safe}" if safe[0].isdigit() else safe
    while safe in taken or safe == "Looks":
        safe += "_"
    taken.add(safe)
    return safe
