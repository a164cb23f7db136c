# pyright: reportAttributeAccessIssue=false
"""Writes USD: constant topology, time samples, metres, Y up."""

import itertools
import pathlib
import re
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ..errors import MissingDependencyError
from ..files import atomic_write
from ..frames import in_chunks
from ..geometry import Texture
from ._animated_mesh import AnimatedMesh, Look, Skinning, smooth_normals, vertex_velocities
from ._texture import write_textures


def write_usd(
    path: str | pathlib.Path,
    meshes: Sequence[AnimatedMesh],
    fps: float,
    *,
    velocities: bool = False,
) -> list[pathlib.Path]:
    """Writes meshes as one animated stage.

    Each mesh is a prim under ``/Person`` with points, normals and extent as time samples
    (frame 0 first), ``st`` texture coordinates and no subdivision. A mesh that is only skinned
    (the built-in body) is written once, bound to an animated skeleton (UsdSkel). Meshes have the
    polygons and materials of the mesh; several materials are bound to subsets of faces, and
    images are written beside the stage. A mesh without materials has a preview material of its
    colour. The stage's up axis is Y, its unit is the metre and its rate is ``fps``.

    Args:
        path: ``.usdc``, ``.usd`` or ``.usda``; written atomically.
        meshes: Meshes to write, all with the same number of frames.
        fps: Frames per second.
        velocities: Write velocities of what isn't skinned too, for motion blur.

    Returns:
        The files written.

    Raises:
        MissingDependencyError: usd-core isn't installed.
    """
    check_usd()
    path = pathlib.Path(path)
    images = write_textures(path, [look.texture for m in meshes for look in m.looks])
    with atomic_write(path) as part:
        _write(part, meshes, fps, {t: image.name for t, image in images.items()}, velocities)
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
    part: pathlib.Path,
    meshes: Sequence[AnimatedMesh],
    fps: float,
    images: dict[Texture, str],
    velocities: bool,
) -> None:
    from pxr import Sdf, Usd, UsdGeom, UsdShade, UsdSkel, Vt

    stage = Usd.Stage.CreateNew(str(part))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetTimeCodesPerSecond(fps)
    stage.SetFramesPerSecond(fps)
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(len(meshes[0].positions) - 1)
    skinned = any(m.skinning is not None for m in meshes)
    root = (UsdSkel.Root if skinned else UsdGeom.Xform).Define(stage, "/Person")
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
        normals = prim.CreateNormalsAttr()
        prim.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
        if m.skinning is not None:
            points.Set(vectors(m.skinning.rest))
            normals.Set(vectors(smooth_normals(m.skinning.rest[None], m.faces)[0]))
            _bind_skeleton(stage, prim, m.skinning, name)
        else:
            k, last = 0, m.positions[:0]
            speed = prim.CreateVelocitiesAttr() if velocities else None
            for chunk in in_chunks(m.positions):
                if k:
                    # What is saved leaves memory.
                    stage.GetRootLayer().Save()
                for j, (x, n) in enumerate(zip(chunk, smooth_normals(chunk, m.faces), strict=True)):
                    points.Set(vectors(x), k + j)
                    normals.Set(vectors(n), k + j)
                if speed is not None:
                    # The last frame's velocity follows from the one before.
                    frames = np.concatenate([last, chunk])
                    for j, v in enumerate(vertex_velocities(frames, fps)):
                        speed.Set(vectors(v), k - len(last) + j)
                    last = frames[-2:].copy()
                k += len(chunk)
        for k, x in enumerate(itertools.chain.from_iterable(in_chunks(m.positions))):
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


def _bind_skeleton(stage: Any, prim: Any, skin: Skinning, name: str) -> None:
    """Defines an animated skeleton, and binds a mesh to it.

    References:
        OpenUSD, UsdSkel schemas: a joint's matrix times the inverse of its bind matrix moves
        the points at rest.
    """
    from pxr import Gf, UsdGeom, UsdSkel, Vt

    paths: list[str] = []
    for joint, parent in zip(skin.names, skin.parents, strict=True):
        own = re.sub(r"[^A-Za-z0-9_]", "_", joint)
        paths.append(own if parent < 0 else f"{paths[parent]}/{own}")
    skeleton = UsdSkel.Skeleton.Define(stage, f"/Person/{name}_skeleton")
    animation = UsdSkel.Animation.Define(stage, f"/Person/{name}_skeleton/motion")
    heads = skin.heads.astype(np.float64)
    parents = np.asarray(skin.parents)
    offsets = heads - np.where(parents[:, None] >= 0, heads[parents], 0.0)
    eye = Gf.Matrix3d(1.0)
    for attribute, places in (
        (skeleton.CreateBindTransformsAttr(), heads),
        (skeleton.CreateRestTransformsAttr(), offsets),
    ):
        attribute.Set(
            Vt.Matrix4dArray([Gf.Matrix4d(eye, Gf.Vec3d(*map(float, p))) for p in places])
        )
    skeleton.CreateJointsAttr(paths)
    animation.CreateJointsAttr(paths)
    UsdSkel.BindingAPI.Apply(skeleton.GetPrim()).CreateAnimationSourceRel().SetTargets(
        [animation.GetPath()]
    )
    turns = skin.rotations.astype(np.float64)
    places = np.einsum("fjab,jb->fja", turns, heads) + skin.translations
    above = np.where((parents >= 0)[None, :, None, None], turns[:, parents], np.eye(3))
    origin = np.where((parents >= 0)[None, :, None], places[:, parents], 0.0)
    local = np.swapaxes(above, 2, 3) @ turns
    step = np.einsum("fjba,fjb->fja", above, places - origin)
    quaternions = (
        Rotation.from_matrix(local.reshape(-1, 3, 3)).as_quat().reshape(*local.shape[:2], 4)
    )
    rotations, translations = animation.CreateRotationsAttr(), animation.CreateTranslationsAttr()
    animation.CreateScalesAttr(Vt.Vec3hArray([Gf.Vec3h(1, 1, 1)] * len(paths)))
    for k in range(len(local)):
        rotations.Set(Vt.QuatfArray.FromNumpy(quaternions[k].astype(np.float32)), k)
        translations.Set(Vt.Vec3fArray.FromNumpy(step[k].astype(np.float32)), k)
    count = int((skin.weights > 0).sum(axis=1).max())
    most = np.argsort(-skin.weights, axis=1, kind="stable")[:, :count]
    share = np.take_along_axis(skin.weights, most, axis=1)
    binding = UsdSkel.BindingAPI.Apply(prim.GetPrim())
    binding.CreateSkeletonRel().SetTargets([skeleton.GetPath()])
    binding.CreateJointIndicesPrimvar(False, count).Set(
        Vt.IntArray.FromNumpy(np.ascontiguousarray(most.ravel(), np.int32))
    )
    binding.CreateJointWeightsPrimvar(False, count).Set(
        Vt.FloatArray.FromNumpy(np.ascontiguousarray(share.ravel(), np.float32))
    )
    binding.CreateGeomBindTransformAttr(Gf.Matrix4d(1.0))
    UsdGeom.Imageable(skeleton).CreatePurposeAttr(UsdGeom.Tokens.guide)


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
