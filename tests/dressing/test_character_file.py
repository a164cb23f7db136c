"""People from other programs: every format says the same, in any unit and axes."""

import dataclasses
import json
import pathlib
import runpy
import struct
import tracemalloc

import numpy as np
import pygltflib
import pytest
from scipy.spatial.transform import Rotation

from physxnet_jax.dressing import read_character
from physxnet_jax.errors import FormatError, PhysXNetError
from physxnet_jax.io import AnimatedMesh, read_mesh, read_pc2, write_clip, write_obj, write_pc2
from physxnet_jax.io._source_mesh import SourceMesh, welded
from physxnet_jax.motion import body_animation, procedural_clip

_SAMPLES = runpy.run_path(str(pathlib.Path(__file__).parents[1] / "samples.py"))
rigged_person = _SAMPLES["rigged_person"]

# A figure of a few triangles, as high as a person.
POINTS = np.array(
    [[0, 0, 0], [0.4, 0, 0], [0.4, 1.7, 0.1], [0, 1.7, 0], [0.2, 0.9, 0.3]], np.float32
)
FACES = np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]], np.int32)


@pytest.fixture
def clip():
    sway = 0.1 * np.sin(np.arange(7.0))[:, None, None] * POINTS[:, 1:2] * [1.0, 0.0, 0.5]
    return (POINTS + sway).astype(np.float32)


@pytest.mark.parametrize("suffix", [".npz", ".usdc", ".usda", ".glb", ".pc2", ".mdd"])
def test_written_characters_are_read_back(clip, tmp_path, suffix):
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0.5, 0.5]])
    body = AnimatedMesh("body", clip, FACES, uv, FACES)
    shirt = AnimatedMesh("shirt", clip[:, :4] + 1, FACES[:, [0, 1, 2]] % 4)
    meshes = [body] if suffix in (".pc2", ".mdd") else [shirt, body]
    write_clip(tmp_path / f"a{suffix}", meshes, 30.0)
    path = tmp_path / (f"a_body{suffix}" if len(meshes) == 1 else f"a{suffix}")
    mesh, bind, notes = read_character(path, fps=30.0)[:3]
    assert mesh.name == "body" and bind is None and notes == ()
    assert mesh.positions.shape == clip.shape and mesh.positions.dtype == np.float32
    # glTF doubles vertices at seams, and their order may change: compare triangles.
    np.testing.assert_allclose(mesh.positions[:, mesh.faces], clip[:, FACES], atol=1e-5)
    if suffix in (".npz", ".usdc", ".glb"):
        other = read_character(path, mesh="shirt")[0]
        np.testing.assert_allclose(other.positions.mean(), shirt.positions.mean(), atol=1e-4)
        with pytest.raises(FormatError, match="no mesh 'hat'; there are body, shirt"):
            read_character(path, mesh="hat")


@pytest.mark.parametrize("unit, scale", [("cm", 100.0), ("mm", 1000.0), ("inches", 1 / 0.0254)])
def test_unit_and_axes_are_detected(clip, tmp_path, unit, scale):
    upright = clip[..., [0, 2, 1]] * [1.0, -1.0, 1.0] * scale
    np.savez(tmp_path / "me.npz", positions=upright, faces=FACES, fps=30.0)
    mesh, _, notes = read_character(tmp_path / "me.npz")[:3]
    np.testing.assert_allclose(mesh.positions, clip, atol=1e-5)
    assert "Z is up" in notes[0] and f"the unit is {unit}" in notes[1]


def test_rate_and_frame_count_are_applied(clip, tmp_path):
    np.savez(tmp_path / "me.npz", positions=clip, faces=FACES, fps=60.0)
    half = read_character(tmp_path / "me.npz", fps=30.0)[0].positions
    np.testing.assert_allclose(half, clip[::2], atol=1e-6)
    double = read_character(tmp_path / "me.npz", fps=120.0)[0].positions
    assert len(double) == 13
    np.testing.assert_allclose(double[1::2], 0.5 * (clip[1:] + clip[:-1]), atol=1e-6)
    assert len(read_character(tmp_path / "me.npz", fps=60.0, frames=3)[0].positions) == 3
    write_pc2(tmp_path / "me.pc2", clip)
    write_obj(tmp_path / "me.obj", clip[0], FACES)
    slow = read_character(tmp_path / "me.pc2", fps=30.0, source_fps=15.0)[0].positions
    np.testing.assert_allclose(slow[::2], clip, atol=1e-6)


@pytest.mark.release
def test_rig_follows_a_retargeted_motion(body, rest, tmp_path):
    """The body's own mesh as a VRM: it goes where the body goes, to a millimetre."""
    walk = procedural_clip("walk", fps=10.0)
    path = rigged_person(tmp_path / "me.vrm", body)
    person, bind, _ = read_character(path, fps=10.0, motion=walk)[:3]
    # Points that coincide are one vertex in a file's mesh: compare triangles.
    true = np.asarray(body_animation(body, walk))[:, np.asarray(body.rest_mesh().faces)]
    lowest = true[..., 1].min()
    np.testing.assert_allclose(
        person.positions[:, person.faces] + [0.0, lowest, 0.0], true, atol=2e-3
    )
    assert bind is not None and person.positions[..., 1].min() == pytest.approx(0.0, abs=1e-5)
    # A glTF stores its times: no source rate changes its speed.
    same = read_character(path, fps=10.0, source_fps=60.0, motion=walk)[0]
    np.testing.assert_array_equal(same.positions, person.positions)
    # The control: without a motion he stands.
    still = read_character(path, fps=10.0)[0]
    assert len(still.positions) == 1
    with pytest.raises(FormatError, match=r"only rigs.*a \.npz file has its own"):
        np.savez(tmp_path / "a.npz", positions=POINTS[None], faces=FACES)
        read_character(tmp_path / "a.npz", motion=walk)


def skinned(
    path, *, turn, scale, joints_of=None, weights=((1, 0), (1, 0), (0, 1), (0, 1), (0.5, 0.5))
):
    """Two joints: the upper one nods; the armature scales and turns, as Blender's do."""
    g = pygltflib.GLTF2(scene=0, scenes=[pygltflib.Scene(nodes=[0, 3])])
    blob = bytearray()

    def put(values, kind, component=5126):
        raw = np.ascontiguousarray(values).tobytes()
        blob.extend(b"\0" * (-len(blob) % 4))
        g.bufferViews.append(
            pygltflib.BufferView(buffer=0, byteOffset=len(blob), byteLength=len(raw))
        )
        blob.extend(raw)
        g.accessors.append(
            pygltflib.Accessor(
                bufferView=len(g.bufferViews) - 1, componentType=component, count=len(values),
                type=kind,
            )
        )  # fmt: skip
        return len(g.accessors) - 1

    g.nodes = [
        pygltflib.Node(
            name="Armature", children=[1], scale=[scale] * 3, rotation=turn.as_quat().tolist()
        ),
        pygltflib.Node(name="low", children=[2], translation=[0, 0, 0]),
        pygltflib.Node(name="high", translation=[0.0, 0.9 / scale, 0.0]),
        pygltflib.Node(name="figure", mesh=0, skin=0, translation=[9.0, 9.0, 9.0]),
    ]
    local = np.linalg.inv(np.diag([scale, scale, scale, 1.0]))
    # Bound in the armature's own space, upright.
    binds = []
    for height in (0.0, 0.9):
        m = np.eye(4)
        m[1, 3] = -height / scale
        binds.append((m @ local).T)
    which = np.tile(np.array([0, 1, 0, 0], np.uint8), (5, 1))
    share = np.zeros((5, 4), np.float32)
    share[:, :2] = weights
    attributes = pygltflib.Attributes(
        POSITION=put(POINTS, "VEC3"),
        JOINTS_0=put(which, "VEC4", 5121),
        WEIGHTS_0=put(share, "VEC4"),
    )
    g.meshes = [
        pygltflib.Mesh(
            primitives=[
                pygltflib.Primitive(
                    attributes=attributes,
                    indices=put(FACES.reshape(-1).astype(np.uint16), "SCALAR", 5123),
                )
            ]
        )
    ]
    g.skins = [
        pygltflib.Skin(
            joints=joints_of or [1, 2],
            inverseBindMatrices=put(np.stack(binds).astype(np.float32).reshape(2, 16), "MAT4"),
        )
    ]
    times = put(np.array([0.0, 1.0], np.float32), "SCALAR")
    nod = np.stack([Rotation.identity().as_quat(), Rotation.from_euler("Z", 0.5).as_quat()])
    g.animations = [
        pygltflib.Animation(
            samplers=[
                pygltflib.AnimationSampler(input=times, output=put(nod.astype(np.float32), "VEC4"))
            ],
            channels=[
                pygltflib.AnimationChannel(
                    sampler=0, target=pygltflib.AnimationChannelTarget(node=2, path="rotation")
                )
            ],
        )
    ]
    g.set_binary_blob(bytes(blob))
    g.buffers.append(pygltflib.Buffer(byteLength=len(blob)))
    g.save(str(path))
    return path


@pytest.mark.parametrize("scale", [1.0, 0.01])
@pytest.mark.parametrize("degrees", [0.0, 35.0])
def test_gltf_skin_matches_linear_blend_skinning(tmp_path, scale, degrees):
    """Against the formula: weighted turns about the joint; the mesh's own node doesn't count."""
    turn = Rotation.from_euler("Y", degrees, degrees=True)
    path = skinned(tmp_path / "a.glb", turn=turn, scale=scale)
    mesh, bind, notes = read_character(path, fps=10.0)[:3]
    assert mesh.positions.shape == (11, 5, 3) and notes == ()
    order = np.lexsort(POINTS.T)
    for k, angle in ((0, 0.0), (5, 0.25), (10, 0.5)):
        nod = Rotation.from_euler("Z", angle).as_matrix()
        high = (POINTS - [0, 0.9, 0]) @ nod.T + [0, 0.9, 0]
        share = np.array([0, 0, 1, 1, 0.5])[:, None]
        expected = ((1 - share) * POINTS + share * high) @ turn.as_matrix().T
        seen = mesh.positions[k][np.lexsort((bind @ turn.as_matrix()).round(5).T)]
        np.testing.assert_allclose(seen, expected[order], atol=1e-5)
    np.testing.assert_allclose(
        np.sort(bind, axis=0), np.sort(POINTS @ turn.as_matrix().T, axis=0), atol=1e-5
    )


def test_invalid_gltf_skins_are_refused(tmp_path):
    turn = Rotation.identity()
    none = ((0, 0),) * 5
    with pytest.raises(FormatError, match="have no joint weights"):
        read_character(skinned(tmp_path / "a.glb", turn=turn, scale=1.0, weights=none))
    with pytest.raises(PhysXNetError, match="joint 77"):
        read_character(skinned(tmp_path / "b.glb", turn=turn, scale=1.0, joints_of=[1, 77]))


def shaped(path, *, sparse=False, mesh_weights=None, node_weights=None):
    """A figure with one morph target, that lifts its head by half a metre."""
    path = pathlib.Path(path)
    lifted = np.zeros((5, 3), np.float32)
    lifted[2:4, 1] = 0.5
    parts = [POINTS, FACES.reshape(-1).astype(np.uint16)]
    if sparse:
        parts += [np.array([2, 3], np.uint16), lifted[2:4]]
    else:
        parts += [lifted]
    blob, views = b"", []
    for part in parts:
        blob += b"\0" * (-len(blob) % 4)
        views.append({"buffer": 0, "byteOffset": len(blob), "byteLength": part.nbytes})
        blob += part.tobytes()
    target = {"componentType": 5126, "count": 5, "type": "VEC3"}
    if sparse:
        target["sparse"] = {
            "count": 2,
            "indices": {"bufferView": 2, "componentType": 5123},
            "values": {"bufferView": 3},
        }
    else:
        target["bufferView"] = 2
    mesh = {
        "primitives": [{"attributes": {"POSITION": 0}, "indices": 1, "targets": [{"POSITION": 2}]}]
    }
    node = {"name": "figure", "mesh": 0}
    if mesh_weights is not None:
        mesh["weights"] = mesh_weights
    if node_weights is not None:
        node["weights"] = node_weights
    gltf_json = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [node],
        "meshes": [mesh],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 5, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5123, "count": 12, "type": "SCALAR"},
            target,
        ],
        "bufferViews": views,
        "buffers": [{"byteLength": len(blob)}],
    }
    if path.suffix == ".gltf":
        path.with_suffix(".bin").write_bytes(blob)
        gltf_json["buffers"][0]["uri"] = path.with_suffix(".bin").name
        path.write_text(json.dumps(gltf_json))
        return path
    text = json.dumps(gltf_json).encode()
    text += b" " * (-len(text) % 4)
    blob += b"\0" * (-len(blob) % 4)
    chunks = struct.pack("<2I", len(text), 0x4E4F534A) + text
    chunks += struct.pack("<2I", len(blob), 0x004E4942) + blob
    path.write_bytes(struct.pack("<3I", 0x46546C67, 2, 12 + len(chunks)) + chunks)
    return path


@pytest.mark.parametrize("suffix", [".gltf", ".glb"])
@pytest.mark.parametrize("sparse", [False, True])
def test_static_morph_target_weights_are_applied(tmp_path, suffix, sparse):
    """Those of the node before those of its mesh; morph targets may be stored sparse."""
    for mesh_weights, node_weights, height in (
        (None, None, 1.7),
        ([0.0], None, 1.7),
        ([1.0], None, 2.2),
        ([1.0], [0.5], 1.95),
        (None, [1.0], 2.2),
    ):
        weights = {"mesh_weights": mesh_weights, "node_weights": node_weights}
        path = shaped(tmp_path / f"a{suffix}", sparse=sparse, **weights)
        for mesh in (read_character(path)[0].positions[0], read_mesh(path).vertices):
            assert np.ptp(mesh[:, 1]) == pytest.approx(height, abs=1e-5), weights
    with pytest.raises(FormatError, match="morph targets"):
        read_character(shaped(tmp_path / f"b{suffix}", mesh_weights=[1.0, 2.0]))


def test_invalid_sparse_accessors_are_refused(tmp_path):
    path = shaped(tmp_path / "a.gltf", sparse=True, mesh_weights=[1.0])
    whole = json.loads(path.read_text())
    for change, says in (
        ({"count": 9}, "sparse in 9 places"),
        ({"count": 0}, "sparse in 0 places"),
        (
            {"indices": {"bufferView": 0, "byteOffset": 12, "componentType": 5123}},
            "sparse indices out of range",
        ),
        ({"indices": {"bufferView": 0, "componentType": 5126}}, "sparse indices out of range"),
        ({"values": {"bufferView": 2}}, "reaches past view 2"),
    ):
        gltf_json = json.loads(path.read_text())
        gltf_json["accessors"][2]["sparse"] |= change
        path.write_text(json.dumps(gltf_json))
        with pytest.raises(PhysXNetError, match=says):
            read_character(path)
        path.write_text(json.dumps(whole))
    del whole["accessors"][2]["sparse"]
    path.write_text(json.dumps(whole))
    with pytest.raises(PhysXNetError, match="no values"):
        read_character(path)


@pytest.mark.parametrize("seconds", [False, True], ids=["frames", "seconds"])
@pytest.mark.parametrize("ranged", [False, True], ids=["silent", "ranged"])
def test_usd_time_samples_are_read_for_any_time_code_rate(tmp_path, seconds, ranged):
    """A second in 25 samples: of one time code each, or within one; with a range or without."""
    from pxr import Usd, UsdGeom, Vt

    stage = Usd.Stage.CreateNew(str(tmp_path / "a.usda"))
    stage.SetTimeCodesPerSecond(1 if seconds else 24)
    mesh = UsdGeom.Mesh.Define(stage, "/figure")
    mesh.CreateFaceVertexCountsAttr([3] * 4)
    mesh.CreateFaceVertexIndicesAttr(FACES.reshape(-1).tolist())
    points = mesh.CreatePointsAttr()
    sway = 0.3 * np.sin(np.arange(25) / 4)
    for k, x in enumerate(sway):
        moved = (POINTS + [x, 0, 0]).astype(np.float32)
        points.Set(Vt.Vec3fArray.FromNumpy(moved), k / 24 if seconds else k)
    if ranged:
        stage.SetStartTimeCode(0)
        stage.SetEndTimeCode(1 if seconds else 24)
    stage.Save()
    found = read_character(tmp_path / "a.usda", fps=24.0)[0].positions
    assert len(found) == 25
    np.testing.assert_allclose(found[:, :, 0].min(axis=1), sway, atol=1e-5)


def test_usd_skinning_is_baked(tmp_path):
    from pxr import Gf, Usd, UsdGeom, UsdSkel, Vt

    stage = Usd.Stage.CreateNew(str(tmp_path / "a.usda"))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    stage.SetTimeCodesPerSecond(10)
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(1)
    root = UsdSkel.Root.Define(stage, "/Me")
    skeleton = UsdSkel.Skeleton.Define(stage, "/Me/Bones")
    skeleton.CreateJointsAttr(["low"])
    one = Vt.Matrix4dArray([Gf.Matrix4d(1)])
    skeleton.CreateBindTransformsAttr(one)
    skeleton.CreateRestTransformsAttr(one)
    motion = UsdSkel.Animation.Define(stage, "/Me/Bones/Clip")
    motion.CreateJointsAttr(["low"])
    motion.CreateRotationsAttr().Set(Vt.QuatfArray([Gf.Quatf(1)]))
    motion.CreateScalesAttr().Set(Vt.Vec3hArray([Gf.Vec3h(1)]))
    shift = motion.CreateTranslationsAttr()
    shift.Set(Vt.Vec3fArray([Gf.Vec3f(0, 0, 0)]), 0)
    shift.Set(Vt.Vec3fArray([Gf.Vec3f(10, 0, 0)]), 1)
    UsdSkel.BindingAPI.Apply(skeleton.GetPrim()).CreateAnimationSourceRel().SetTargets(
        [motion.GetPath()]
    )
    mesh = UsdGeom.Mesh.Define(stage, "/Me/figure")
    upright = 100 * POINTS[:, [0, 2, 1]] * [1, -1, 1]
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(upright.astype(np.float32)))
    mesh.CreateFaceVertexCountsAttr([3] * 4)
    mesh.CreateFaceVertexIndicesAttr(FACES.reshape(-1).tolist())
    api = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    api.CreateSkeletonRel().SetTargets([skeleton.GetPath()])
    api.CreateJointIndicesPrimvar(False, 1).Set([0] * 5)
    api.CreateJointWeightsPrimvar(False, 1).Set([1.0] * 5)
    assert root
    stage.Save()
    found, bind, _ = read_character(tmp_path / "a.usda", fps=10.0)[:3]
    np.testing.assert_allclose(np.sort(bind, axis=0), np.sort(POINTS, axis=0), atol=1e-5)
    expected = np.stack([POINTS, POINTS + [0.1, 0, 0]])
    np.testing.assert_allclose(found.positions, expected, atol=1e-5)


def test_long_caches_keep_their_rate_and_all_frames(tmp_path):
    sway = 0.1 * np.sin(0.3 * np.arange(151.0))[:, None, None] * POINTS[:, 1:2] * [1.0, 0.0, 0.5]
    long = (POINTS + sway).astype(np.float32)
    for fps in (30.0, 24.0, 30000.0 / 1001.0):
        write_clip(tmp_path / "a.mdd", [AnimatedMesh("body", long, FACES)], fps)
        again = read_character(tmp_path / "a_body.mdd", fps=fps)[0].positions
        assert len(again) == 151
        # As 32-bit times tell it: no frame is mixed from two.
        np.testing.assert_allclose(again, long, atol=2e-6)


@pytest.mark.parametrize("suffix", [".glb", ".npz", ".usdc"])
def test_one_frame_file_is_a_static_character(clip, tmp_path, suffix):
    write_clip(tmp_path / f"a{suffix}", [AnimatedMesh("body", clip[:1], FACES)], 30.0)
    mesh = read_character(tmp_path / f"a{suffix}")[0]
    assert mesh.positions.shape[0] == 1
    np.testing.assert_allclose(mesh.positions[:, mesh.faces], clip[:1, FACES], atol=1e-5)


def test_usd_orientation_is_read_and_a_missing_up_axis_is_detected(clip, tmp_path):
    write_clip(tmp_path / "a.usda", [AnimatedMesh("body", clip, FACES)], 30.0)
    text = (tmp_path / "a.usda").read_text()
    assert 'upAxis = "Y"' in text and 'orientation = "' not in text
    left = text.replace("int[] faceVertexIndices", 'uniform token orientation = "leftHanded"\n'
                        "        int[] faceVertexIndices")  # fmt: skip
    (tmp_path / "b.usda").write_text(left)
    mesh = read_character(tmp_path / "b.usda")[0]
    np.testing.assert_array_equal(mesh.faces, FACES[:, ::-1])
    # Z up, unsaid: found by how high the person is, as in files that can't say it.
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    stage.ClearMetadata("upAxis")
    for prim in stage.Traverse():
        if prim.IsA(UsdGeom.Mesh):
            points = UsdGeom.Mesh(prim).GetPointsAttr()
            for code in points.GetTimeSamples():
                x = np.asarray(points.Get(code))[:, [0, 2, 1]] * np.float32([1.0, -1.0, 1.0])
                points.Set([tuple(map(float, p)) for p in x], code)
    stage.Export(str(tmp_path / "c.usda"))
    mesh, _, notes = read_character(tmp_path / "c.usda")[:3]
    assert "Z is up" in notes[0]
    np.testing.assert_allclose(mesh.positions, clip, atol=1e-5)


def test_size_limits_apply_to_all_meshes_together(clip, tmp_path, monkeypatch):
    three = [AnimatedMesh(f"part{k}", clip, FACES) for k in range(3)]
    for suffix, room in ((".glb", "_gltf_mesh"), (".usdc", "_usd_mesh")):
        write_clip(tmp_path / f"a{suffix}", three, 30.0)
        size = float(read_character(tmp_path / f"a{suffix}")[0].positions.size)
        with monkeypatch.context() as less:
            less.setattr(f"physxnet_jax.io.{room}._MOST", 0.9 * size)
            with pytest.raises(FormatError, match=r"Cut the clip|changes its number"):
                read_character(tmp_path / f"a{suffix}")


def test_usd_stages_read_nothing_outside_their_folder(tmp_path, clip):
    (tmp_path / "in").mkdir()
    write_clip(tmp_path / "secret.usda", [AnimatedMesh("body", clip, FACES)], 30.0)
    write_clip(tmp_path / "in/near.usda", [AnimatedMesh("body", clip, FACES)], 30.0)
    for name, fine in (("../secret.usda", False), ("near.usda", True)):
        path = tmp_path / "in/a.usda"
        path.write_text(f'#usda 1.0\n(\n    subLayers = [@./{name}@]\n    upAxis = "Y"\n)\n')
        if fine:
            np.testing.assert_allclose(read_character(path)[0].positions[0], clip[0], atol=1e-5)
        else:
            with pytest.raises(FormatError, match="outside its folder"):
                read_character(path)


def test_small_files_cannot_claim_much_memory(tmp_path):
    """Hours of animation of a few vertices, and frames that nobody has."""
    turn = Rotation.identity()
    g = pygltflib.GLTF2().load_binary(str(skinned(tmp_path / "a.glb", turn=turn, scale=1.0)))
    blob = bytearray(g.binary_blob())
    view = g.bufferViews[g.accessors[g.animations[0].samplers[0].input].bufferView]
    blob[view.byteOffset : view.byteOffset + 8] = np.array([0, 9e4], "<f4").tobytes()
    g.set_binary_blob(bytes(blob))
    g.save(str(tmp_path / "b.glb"))
    (tmp_path / "c.usda").write_text(
        "#usda 1.0\n(\n    startTimeCode = 0\n    endTimeCode = 900000\n)\n"
    )
    # Two frames an hour apart.
    still = np.zeros((2, 3000, 3), np.float32)
    np.savez(tmp_path / "d.npz", positions=still, faces=FACES, fps=1e-4)
    for name in ("b.glb", "c.usda", "d.npz"):
        tracemalloc.start()
        with pytest.raises(PhysXNetError, match=name):
            read_character(tmp_path / name)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 100e6


def test_broken_character_files_are_refused_with_a_message(clip, tmp_path):
    def refused(match, name, **arrays):
        if arrays:
            np.savez(tmp_path / name, **arrays)
        with pytest.raises(FormatError, match=match):
            read_character(tmp_path / name)

    refused("'.fbx' isn't a format of animated persons", "a.fbx")
    refused("no such file", "gone.npz")
    refused("no mesh that moves", "a.npz", x=clip)
    refused("triangles over 5", "b.npz", positions=clip, faces=FACES + 2)
    refused("fps isn't", "c.npz", positions=clip, faces=FACES, fps=-1.0)
    refused("aren't finite", "d.npz", positions=clip * np.nan, faces=FACES)
    refused("no person's height", "e.npz", positions=clip * 7e5, faces=FACES)
    refused("'faces' beside it", "f.npz", positions=clip)
    refused("with body 0 frames", "f0.npz", positions=clip[:0], faces=FACES)
    parts = {"a_positions": clip, "b_positions": clip[:3], "a_faces": FACES, "b_faces": FACES}
    refused("a 7, b 3 frames", "f1.npz", **parts)
    write_pc2(tmp_path / "g.pc2", clip)
    refused("put the OBJ", "g.pc2")
    write_obj(tmp_path / "g.obj", POINTS[:4], np.array([[0, 1, 2]]))
    refused("5 points, but g.obj has 4", "g.pc2")
    (tmp_path / "h.usda").write_text("#usda 1.0\n(nonsense")
    refused("not a USD stage", "h.usda")
    document = {"asset": {"version": "2.0"}, "nodes": [{"name": "a"}]}
    blob = json.dumps(document).encode()
    blob += b" " * (-len(blob) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 20 + len(blob)) + struct.pack(
        "<II", len(blob), 0x4E4F534A
    )
    (tmp_path / "i.glb").write_bytes(head + blob)
    with pytest.raises(PhysXNetError, match="no mesh that moves"):
        read_character(tmp_path / "i.glb")


@pytest.mark.parametrize(
    "wrong",
    [
        {"fps": 0.0},
        {"fps": -5.0},
        {"fps": float("nan")},
        {"source_fps": 0.0},
        {"source_fps": -3.0},
        {"frames": 0},
        {"frames": -1},
    ],
)
def test_invalid_rates_and_frame_counts_are_refused(clip, tmp_path, wrong):
    np.savez(tmp_path / "me.npz", positions=clip, faces=FACES, fps=30.0)
    with pytest.raises(FormatError, match=f"^{next(iter(wrong))} is .*expected"):
        read_character(tmp_path / "me.npz", **wrong)


def test_vertices_that_touch_in_some_frames_are_not_welded():
    """Hands clap at the start and the end; a seam's doubles stay together all the time."""
    x = np.array(
        [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 0], [1, 0, 0], [0, 0, 1], [1, 0, 0]], float
    )
    clip = np.stack([x, x, x]).astype(np.float32)
    clip[1, 3:] += 0.5
    part = SourceMesh("hands", clip, np.array([[0, 1, 2], [3, 4, 5], [3, 6, 5]], np.int32))
    one = welded(part)
    assert one.positions.shape[1] == 6, "4 and 6 are one; 3 and 4 aren't 0 and 1"
    np.testing.assert_array_equal(one.positions[:, one.faces], clip[:, part.faces])
    still = welded(dataclasses.replace(part, positions=clip[:1]))
    assert still.positions.shape[1] == 4, "the control: in one frame they are"


def test_caches_without_a_sample_per_frame_are_refused(clip, tmp_path):
    write_pc2(tmp_path / "a.pc2", clip)
    blob = bytearray((tmp_path / "a.pc2").read_bytes())
    struct.pack_into("<f", blob, 24, 2.0)
    (tmp_path / "a.pc2").write_bytes(blob)
    with pytest.raises(FormatError, match="every 2 frames"):
        read_pc2(tmp_path / "a.pc2")


def test_an_obj_is_a_person_who_stands_still(tmp_path):
    write_obj(tmp_path / "a.obj", 100 * POINTS, FACES)
    person = read_character(tmp_path / "a.obj")
    assert person[0].positions.shape == (1, len(POINTS), 3)
    np.testing.assert_allclose(np.ptp(person[0].positions[0, :, 1]), 1.7, atol=1e-5)


@pytest.mark.release
def test_the_body_of_a_stage_is_a_skeleton_with_one_mesh(tmp_path):
    """It moves as its vertices do, in a file that doesn't hold them."""
    usd = pytest.importorskip("pxr.Usd")
    from pxr import UsdSkel

    from physxnet_jax.dressing import dress

    clip = dress("walk", ["bottom"], method="lbs", frames=12)
    (path,) = write_clip(tmp_path / "a.usdc", clip.meshes, 30.0)
    whole = read_character(path, fps=30.0, mesh="body").mesh.positions
    np.testing.assert_allclose(whole, clip.meshes[0].positions, atol=3e-6)
    stage = usd.Stage.Open(str(path))
    points = stage.GetPrimAtPath("/Person/body").GetAttribute("points")
    assert points.GetNumTimeSamples() == 0
    assert stage.GetPrimAtPath("/Person").IsA(UsdSkel.Root)
    skeleton = UsdSkel.Skeleton(stage.GetPrimAtPath("/Person/body_skeleton"))
    assert len(skeleton.GetJointsAttr().Get()) == 31
    # What isn't skinned alone is written point by point.
    cloth = stage.GetPrimAtPath("/Person/bottom").GetAttribute("points")
    assert cloth.GetNumTimeSamples() == 12
    plain = dataclasses.replace(clip.meshes[0], skinning=None)
    (baked,) = write_clip(tmp_path / "b.usdc", [plain], 30.0)
    assert baked.stat().st_size > 1.5 * path.stat().st_size
