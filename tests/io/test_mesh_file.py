"""A garment is the same one whichever format it comes in."""

import base64
import json
import os

import numpy as np
import pytest
import trimesh
from scipy.spatial import KDTree

from physxnet_jax.dressing import inspect_garment
from physxnet_jax.errors import FormatError, PhysXNetError
from physxnet_jax.garment import load_garment, template
from physxnet_jax.io import (
    GARMENT_FORMATS,
    AnimatedMesh,
    mesh_name,
    read_mesh,
    write_clip,
    write_obj,
)


@pytest.fixture(scope="module")
def trousers():
    """The template's mesh, and a chart whose seam doubles vertices in glTF and PLY."""
    mesh = template("bottom").mesh
    v, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    around = np.arctan2(v[:, 0], v[:, 2]) / (2 * np.pi) + 0.5
    u = around[faces]
    u = np.where((np.ptp(u, axis=1, keepdims=True) > 0.5) & (u < 0.5), u + 1.0, u)
    corners = np.stack([u, v[faces][..., 1]], axis=2).reshape(-1, 2)
    uv, index = np.unique(np.round(corners, 5), axis=0, return_inverse=True)
    return v, faces, uv, index.reshape(-1, 3).astype(np.int32)


def saved(folder, suffix, trousers):
    v, faces, uv, uv_faces = trousers
    path = folder / f"trousers{suffix}"
    if suffix == ".obj":
        write_obj(path, *trousers)
    elif suffix in (".ply", ".stl"):
        # A program that writes PLY with a chart doubles what lies on its seam.
        pairs, index = np.unique(
            np.stack([faces, uv_faces], axis=2).reshape(-1, 2), axis=0, return_inverse=True
        )
        chart = trimesh.visual.TextureVisuals(uv=uv[pairs[:, 1]])
        mesh = trimesh.Trimesh(v[pairs[:, 0]], index.reshape(-1, 3), process=False, visual=chart)
        mesh.export(path)
    elif suffix == ".usdz":
        utils = pytest.importorskip("pxr.UsdUtils")
        assert utils.CreateNewUsdzPackage(str(saved(folder, ".usdc", trousers)), str(path))
    else:
        write_clip(path, [AnimatedMesh("trousers", v[None], faces, uv, uv_faces)], 30.0)
    return path


@pytest.mark.parametrize("suffix", [s for s in GARMENT_FORMATS if s not in (".gltf", ".usd")])
def test_all_formats_give_the_same_mesh(suffix, trousers, tmp_path):
    v, faces, uv, uv_faces = trousers
    mesh = read_mesh(saved(tmp_path, suffix, trousers))
    assert mesh.vertices.shape == v.shape, "what lies on a seam is one vertex"
    np.testing.assert_allclose(mesh.vertices[mesh.faces], v[faces], atol=1e-6)
    assert mesh.count == len(faces)
    if suffix == ".stl":
        assert mesh.uv is None
    else:
        np.testing.assert_allclose(mesh.uv[mesh.uv_faces], uv[uv_faces], atol=1e-5)


def test_glb_garment_matches_the_obj_garment(trousers, tmp_path):
    wanted, _ = load_garment(saved(tmp_path, ".obj", trousers))
    garment, report = load_garment(saved(tmp_path, ".glb", trousers))
    assert (report.unit, report.up, report.template) == ("m", "Y", "bottom")
    off, order = KDTree(wanted.mesh.vertices).query(garment.mesh.vertices)
    assert off.max() < 1e-5 and len(set(order)) == len(order)
    np.testing.assert_array_equal(garment.pinned, np.asarray(wanted.pinned)[order])
    np.testing.assert_allclose(garment.skin, np.asarray(wanted.skin)[order], atol=1e-3)
    assert garment.name == "trousers"


def test_mesh_without_seams_keeps_its_vertex_order(trousers, tmp_path):
    v, faces, _, _ = trousers
    trimesh.Trimesh(v, faces, process=False).export(tmp_path / "a.ply")
    write_clip(tmp_path / "a.usda", [AnimatedMesh("a", v[None], faces)], 30.0)
    for name in ("a.ply", "a.usda"):
        mesh = read_mesh(tmp_path / name)
        np.testing.assert_allclose(mesh.vertices, v, atol=1e-6)
        np.testing.assert_array_equal(mesh.faces, faces)


@pytest.mark.release
@pytest.mark.parametrize("suffix", [".glb", ".usda"])
def test_one_of_several_meshes_is_selected_by_name(suffix, trousers, tmp_path):
    v, faces, _, _ = trousers
    person = AnimatedMesh("person", v[None] + np.float32(0.3), faces[:40])
    path = tmp_path / f"both{suffix}"
    write_clip(path, [person, AnimatedMesh("trousers", v[None], faces)], 30.0)
    both, one = read_mesh(path), read_mesh(f"{path}#trousers")
    assert both.parts == ("person", "trousers") and one.parts == ("trousers",)
    assert len(both.faces) == len(faces) + 40 and len(one.faces) == len(faces)
    assert load_garment(f"{path}#trousers:as=bottom")[0].name == "both_trousers"
    with pytest.raises(FormatError, match="no mesh 'hat'; there are person, trousers"):
        read_mesh(f"{path}#hat")
    if suffix == ".usda":
        return
    found = inspect_garment(path)
    assert any("2 meshes (person, trousers)" in n and "both" in n for n in found.notes)
    assert not any("meshes" in n for n in inspect_garment(f"{path}#trousers").notes)


def test_rigged_mesh_is_read_in_its_bind_pose(tmp_path):
    """Where its node stands now, and how its joints have been turned, says nothing of it."""
    text = """#usda 1.0
(
    metersPerUnit = 0.01
    upAxis = "Z"
)
def SkelRoot "person"
{
    def Mesh "shirt" (prepend apiSchemas = ["SkelBindingAPI"])
    {
        int[] faceVertexCounts = [4, 3]
        int[] faceVertexIndices = [0, 1, 2, 3, 1, 4, 2]
        point3f[] points = [(0, 0, 0), (1, 0, 0), (1, 0, 1), (0, 0, 1), (2, 0, 0)]
        texCoord2f[] primvars:st = [(0, 0), (1, 0)] (interpolation = "faceVarying")
        int[] primvars:st:indices = [0, 1, 1, 0, 1, 0, 1]
        matrix4d primvars:skel:geomBindTransform = BIND
        double3 xformOp:translate = (900, 0, 0)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }
}
"""
    bind = "((10, 0, 0, 0), (0, 10, 0, 0), (0, 0, 10, 0), (0, 0, 5, 1))"
    (tmp_path / "a.usda").write_text(text.replace("BIND", bind))
    mesh = read_mesh(tmp_path / "a.usda")
    wanted = np.array([[0, 0, 5], [10, 0, 5], [10, 0, 15], [0, 0, 15], [20, 0, 5]]) * 0.01
    np.testing.assert_allclose(mesh.vertices, wanted, atol=1e-6)
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [0, 2, 3], [1, 4, 2]])
    np.testing.assert_array_equal(mesh.uv[mesh.uv_faces][..., 0], [[0, 1, 1], [0, 1, 0], [1, 0, 1]])


def test_files_without_a_valid_mesh_are_refused(trousers, tmp_path):
    for name, blob, message in (
        ("a.fbx", b"Kaydara FBX Binary", "'.fbx'"),
        ("a.ply", b"ply\nformat binary_little_endian 1.0\n", "not a mesh"),
        ("b.ply", saved(tmp_path, ".ply", trousers).read_bytes()[:-9], "not a mesh"),
        ("a.stl", b"\0" * 84, "a mesh needs both"),
        ("a.usda", b"#usda 1.0\n", "no mesh in it"),
    ):
        (tmp_path / name).write_bytes(blob)
        with pytest.raises(FormatError, match=message):
            read_mesh(tmp_path / name)
    with pytest.raises(FormatError, match="no such file"):
        read_mesh(tmp_path / "none.glb")
    path = saved(tmp_path, ".obj", trousers)
    with pytest.raises(FormatError, match="no mesh 'sleeves'; there is one mesh without a name"):
        read_mesh(f"{path}#sleeves")
    path = saved(tmp_path, ".ply", trousers)
    with pytest.raises(FormatError, match="holds one mesh"):
        read_mesh(f"{path}#sleeves")
    with pytest.raises(PhysXNetError, match="or a file"):
        load_garment("hat")


def test_flat_shaded_stl_is_welded_into_one_component(trousers, tmp_path):
    """Every triangle of an STL has corners of its own."""
    v, faces, _, _ = trousers
    trimesh.Trimesh(v, faces, process=False).export(tmp_path / "a.stl")
    assert inspect_garment(tmp_path / "a.stl").health.components == 1


@pytest.mark.parametrize("kind", ["scale", "matrix", "usda"])
def test_mirrored_transforms_keep_faces_pointing_outwards(tmp_path, kind):
    """A ball mirrored by its node or prim still encloses what is in it."""
    ball = trimesh.creation.icosphere(subdivisions=1)
    x, faces = np.asarray(ball.vertices, "<f4") + np.float32([2, 0, 0]), np.asarray(ball.faces)
    if kind == "usda":
        pytest.importorskip("pxr")
        path = tmp_path / "a.usda"
        path.write_text(
            '#usda 1.0\n(\n metersPerUnit = 1\n upAxis = "Y"\n)\ndef Mesh "ball"\n{\n'
            f" int[] faceVertexCounts = {[3] * len(faces)}\n"
            f" int[] faceVertexIndices = {faces.ravel().tolist()}\n"
            f" point3f[] points = {[tuple(p) for p in x.astype(float).tolist()]}\n"
            " double3 xformOp:scale = (-1, 1, 1)\n"
            ' uniform token[] xformOpOrder = ["xformOp:scale"]\n}\n'
        )
    else:
        pytest.importorskip("pygltflib")
        blob = x.tobytes() + faces.astype("<u4").tobytes()
        node = {"scale": {"scale": [-1, 1, 1]}}.get(
            kind, {"matrix": [-1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}
        )
        document = {
            "asset": {"version": "2.0"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{**node, "mesh": 0, "name": "ball"}],
            "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
            "buffers": [
                {
                    "byteLength": len(blob),
                    "uri": "data:application/octet-stream;base64,"
                    + base64.b64encode(blob).decode(),
                }
            ],
            "bufferViews": [
                {"buffer": 0, "byteOffset": 0, "byteLength": x.nbytes},
                {"buffer": 0, "byteOffset": x.nbytes, "byteLength": len(blob) - x.nbytes},
            ],
            "accessors": [
                {"bufferView": 0, "componentType": 5126, "count": len(x), "type": "VEC3"},
                {"bufferView": 1, "componentType": 5125, "count": faces.size, "type": "SCALAR"},
            ],
        }
        path = tmp_path / "a.gltf"
        path.write_text(json.dumps(document))
    mesh = read_mesh(path)
    assert mesh.vertices[:, 0].max() == pytest.approx(-1.0, abs=1e-6)
    corner = mesh.vertices[mesh.faces] - [-2, 0, 0]
    assert np.linalg.det(corner).sum() / 6 == pytest.approx(ball.volume, rel=1e-4)
    assert mesh.polygons is not None
    np.testing.assert_array_equal(
        np.sort(mesh.polygons.corners.reshape(-1, 3)), np.sort(mesh.faces)
    )
    ring = mesh.vertices[mesh.polygons.corners.reshape(-1, 3)] - [-2, 0, 0]
    assert np.linalg.det(ring).sum() > 0


def test_damaged_packages_are_refused(trousers, tmp_path):
    path = saved(tmp_path, ".usdz", trousers)
    path.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(FormatError, match=r"trousers\.usdz"):
        read_mesh(path)


def test_names_of_files_that_are_not_utf8_can_be_written():
    for path in (os.fsdecode(b"g/\xff\xfe.obj"), os.fsdecode(b"g/a.glb#\xff")):
        assert mesh_name(path).encode("utf-8")
    assert mesh_name("g/m\u00e4ntel.obj") == "m\u00e4ntel"
