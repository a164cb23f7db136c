"""A dressed clip through every format and back, by readers that aren't ours.

Command: python experiments/round_trips.py
Cost:    half a minute.
Result:  experiments/results/round_trips.md, shown in docs/garments.md: size of the files, and
         the largest distance of a vertex, in any frame, from where it was. MDD and PC2 are
         taken apart as their descriptions say; Blender reads them in import_in_blender.py.
"""

import base64
import pathlib
import re
import struct
import tempfile
from collections.abc import Callable, Iterator

import numpy as np
import pygltflib
import trimesh
from jaxtyping import Float
from pxr import Usd, UsdGeom, UsdSkel

from physxnet_jax.dressing import dress
from physxnet_jax.files import atomic_write
from physxnet_jax.io import AnimatedMesh, write_clip

RESULTS = pathlib.Path(__file__).parent / "results/round_trips.md"
PAGE = pathlib.Path(__file__).parents[1] / "docs/garments.md"
FPS = 30.0
Read = Iterator[tuple[AnimatedMesh, Float[np.ndarray, "frames corners 3"]]]


def corners(mesh: AnimatedMesh) -> Float[np.ndarray, "frames corners 3"]:
    """Positions of every corner of every face: formats may double vertices at seams."""
    return mesh.positions[:, mesh.faces.ravel()]


def usd(files: list[pathlib.Path], meshes: list[AnimatedMesh]) -> Read:
    stage = Usd.Stage.Open(str(files[0]))
    for m in meshes:
        prim = UsdGeom.Mesh(stage.GetPrimAtPath(f"/Person/{m.name}"))
        index = np.asarray(prim.GetFaceVertexIndicesAttr().Get())
        skin = UsdSkel.BindingAPI(prim.GetPrim()).GetInheritedSkeleton()
        if skin:
            frames = [_skinned(prim, skin, k) for k in range(len(m.positions))]
        else:
            frames = [np.asarray(prim.GetPointsAttr().Get(k)) for k in range(len(m.positions))]
        yield m, np.stack(frames)[:, index]


def _skinned(prim: UsdGeom.Mesh, skeleton: UsdSkel.Skeleton, frame: int) -> np.ndarray:
    """Points as USD's own library skins them."""
    cache = UsdSkel.Cache()
    root = UsdSkel.Root(prim.GetPrim().GetParent())
    cache.Populate(root, Usd.PrimDefaultPredicate)
    query = cache.GetSkinningQuery(prim.GetPrim())
    transforms = cache.GetSkelQuery(skeleton).ComputeSkinningTransforms(frame)
    points = prim.GetPointsAttr().Get(frame)
    # In place.
    assert query.ComputeSkinnedPoints(transforms, points, frame)
    return np.asarray(points)


def glb(files: list[pathlib.Path], meshes: list[AnimatedMesh]) -> Read:
    yield from _gltf(pygltflib.GLTF2().load_binary(str(files[0])), meshes)


def html(files: list[pathlib.Path], meshes: list[AnimatedMesh]) -> Read:
    found = max(re.findall(r"[A-Za-z0-9+/=]{1000,}", files[0].read_text()), key=len)
    yield from _gltf(pygltflib.GLTF2.load_from_bytes(base64.b64decode(found)), meshes)


def _gltf(document: pygltflib.GLTF2 | None, meshes: list[AnimatedMesh]) -> Read:
    assert document is not None
    blob = document.binary_blob()
    assert blob is not None

    def values(which: int | None) -> np.ndarray:
        assert which is not None
        a = document.accessors[which]
        view = document.bufferViews[a.bufferView or 0]
        width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3}[a.type]
        dtype = "<u4" if a.componentType == pygltflib.UNSIGNED_INT else "<f4"
        start = (view.byteOffset or 0) + (a.byteOffset or 0)
        return np.frombuffer(blob, dtype, a.count * width, start).reshape(-1, width)

    for m, shape in zip(meshes, document.meshes, strict=True):
        part = shape.primitives[0]
        base, index = values(part.attributes.POSITION), values(part.indices).ravel()
        moved = [base] + [base + values(t["POSITION"]) for t in part.targets or ()]
        yield m, np.stack(moved)[:, index]


def pc2(files: list[pathlib.Path], meshes: list[AnimatedMesh]) -> Read:
    for m, path in zip(meshes, (f for f in files if f.suffix == ".pc2"), strict=True):
        blob = path.read_bytes()
        _, vertices, _, _, frames = struct.unpack_from("<iiffi", blob, 12)
        x = np.frombuffer(blob, "<f4", offset=32).reshape(frames, vertices, 3)
        yield m, x[:, _faces(path)]


def mdd(files: list[pathlib.Path], meshes: list[AnimatedMesh]) -> Read:
    for m, path in zip(meshes, (f for f in files if f.suffix == ".mdd"), strict=True):
        frames, vertices = struct.unpack_from(">ii", blob := path.read_bytes())
        x = np.frombuffer(blob, ">f4", offset=8 + 4 * frames).reshape(frames, vertices, 3)
        yield m, x[:, _faces(path)]


def _faces(path: pathlib.Path) -> np.ndarray:
    mesh = trimesh.load(path.with_suffix(".obj"), process=False, maintain_order=True)
    assert isinstance(mesh, trimesh.Trimesh)
    return np.asarray(mesh.faces).ravel()


def obj(files: list[pathlib.Path], meshes: list[AnimatedMesh]) -> Read:
    for m in meshes:
        frames = []
        for path in sorted(f for f in files if f"_{m.name}_" in f.name):
            mesh = trimesh.load(path, process=False, maintain_order=True)
            assert isinstance(mesh, trimesh.Trimesh)
            frames.append(np.asarray(mesh.vertices)[np.asarray(mesh.faces).ravel()])
        yield m, np.stack(frames)


def npz(files: list[pathlib.Path], meshes: list[AnimatedMesh]) -> Read:
    with np.load(files[0]) as data:
        for m in meshes:
            yield m, data[f"{m.name}_positions"][:, data[f"{m.name}_faces"].ravel()]


FORMATS: dict[str, tuple[Callable[[list[pathlib.Path], list[AnimatedMesh]], Read], str]] = {
    ".usdc": (usd, "usd-core"),
    ".usda": (usd, "usd-core"),
    ".glb": (glb, "pygltflib"),
    ".html": (html, "pygltflib, from the page's text"),
    ".pc2": (pc2, "its description; trimesh for the OBJ"),
    ".mdd": (mdd, "its description; trimesh for the OBJ"),
    ".obj": (obj, "trimesh"),
    ".npz": (npz, "NumPy"),
}


def table(meshes: list[AnimatedMesh]) -> str:
    """A line for each format."""
    lines = ["| format | read back by | MB | largest distance, m |", "|---|---|---|---|"]
    for ending, (reader, who) in FORMATS.items():
        with tempfile.TemporaryDirectory() as folder:
            files = write_clip(pathlib.Path(folder) / f"clip{ending}", meshes, FPS)
            size = sum(f.stat().st_size for f in files) / 1e6
            gaps = [float(np.abs(x - corners(m)).max()) for m, x in reader(files, meshes)]
        assert len(gaps) == len(meshes), ending
        lines.append(f"| `{ending}` | {who} | {size:.1f} | {max(gaps):.1e} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    clip = dress("walk", ["top", "bottom"], method="lbs", frames=20)
    text = table(list(clip.meshes))
    with atomic_write(RESULTS) as part:
        part.write_text(text)
    mark = re.compile(r"(<!-- begin round_trips -->\n).*?(<!-- end round_trips -->)", re.S)
    with atomic_write(PAGE) as part:
        part.write_text(mark.sub(lambda m: m[1] + text + m[2], PAGE.read_text()))


if __name__ == "__main__":
    main()
