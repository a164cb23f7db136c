"""Motion from glTF and AMASS files, against the clip they were made from."""

import base64
import json
import pathlib
import runpy

import numpy as np
import pygltflib
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st
from scipy.spatial.transform import Rotation

from physxnet_jax.body import t_pose
from physxnet_jax.errors import MotionError
from physxnet_jax.io._gltf_file import GltfFile
from physxnet_jax.motion import (
    JOINT_MAPS,
    LIMBS,
    clip_transforms,
    inspect_motion,
    load_motion,
    make_motion,
    procedural_clip,
    read_gltf,
)

TESTS = pathlib.Path(__file__).parents[1]
_SAMPLES = runpy.run_path(str(TESTS / "samples.py"))
limbs_apart = _SAMPLES["limbs_apart"]


def write_gltf(path, body, rest, motion, mode="LINEAR", scale=0.01):
    """The motion as Mixamo joints under an armature node that scales and turns."""
    names = JOINT_MAPS["mixamo"]
    world, shift = (np.asarray(x, np.float64) for x in clip_transforms(body, rest, motion))
    heads = np.asarray(body.joint_positions(rest)[0], np.float64)
    chosen = [b for b in body.joint_names if b in names]
    index = body.joint_names.index
    parent = {}
    for b in chosen:
        j = body.parents[index(b)]
        while j >= 0 and body.joint_names[j] not in names:
            j = body.parents[j]
        parent[b] = body.joint_names[j] if j >= 0 else None
    turn = Rotation.from_euler("X", 90, degrees=True).as_matrix()
    root = np.einsum("fab,b->fa", world[:, 0], heads[0]) + shift[:, 0]
    g = pygltflib.GLTF2(scene=0, scenes=[pygltflib.Scene(nodes=[0])])
    g.nodes.append(
        pygltflib.Node(
            name="Armature",
            children=[1],
            scale=[scale] * 3,
            rotation=Rotation.from_matrix(turn.T).as_quat().tolist(),
        )
    )
    blob = bytearray()

    def put(values, kind):
        values = np.ascontiguousarray(values, np.float32)
        g.bufferViews.append(
            pygltflib.BufferView(buffer=0, byteOffset=len(blob), byteLength=values.nbytes)
        )
        g.accessors.append(
            pygltflib.Accessor(
                bufferView=len(g.bufferViews) - 1, componentType=5126, count=len(values), type=kind
            )
        )
        blob.extend(values.tobytes())
        return len(g.accessors) - 1

    frames = len(root)
    times = put(np.arange(frames) / motion.fps, "SCALAR")
    channels, samplers = [], []

    def track(node, kind, values):
        if mode == "CUBICSPLINE":
            slope = np.gradient(values, axis=0) * motion.fps
            values = np.stack([slope, values, slope], axis=1).reshape(3 * frames, -1)
        out = put(values, "VEC4" if kind == "rotation" else "VEC3")
        samplers.append(pygltflib.AnimationSampler(input=times, output=out, interpolation=mode))
        target = pygltflib.AnimationChannelTarget(node=node, path=kind)
        channels.append(pygltflib.AnimationChannel(sampler=len(samplers) - 1, target=target))

    for k, b in enumerate(chosen, start=1):
        mother = parent[b]
        offset = heads[index(b)] - (heads[index(mother)] if mother else 0.0)
        if mother is None:
            offset = turn @ offset
            local = turn @ world[:, 0]
        else:
            local = np.swapaxes(world[:, index(mother)], 1, 2) @ world[:, index(b)]
        kids = [chosen.index(c) + 1 for c in chosen if parent[c] == b]
        g.nodes.append(
            pygltflib.Node(
                name="mixamorig:" + names[b],
                children=kids,
                translation=(offset / scale).tolist(),
                rotation=Rotation.from_matrix(turn).as_quat().tolist() if mother is None else None,
            )
        )
        q = Rotation.from_matrix(local).as_quat()
        sign = np.cumprod(np.where((q[1:] * q[:-1]).sum(1) < 0, -1.0, 1.0))
        q[1:] *= sign[:, None]
        track(k, "rotation", q)
        if mother is None:
            track(k, "translation", root @ turn.T / scale)
    g.skins.append(pygltflib.Skin(joints=list(range(1, len(chosen) + 1))))
    g.animations.append(pygltflib.Animation(channels=channels, samplers=samplers))
    uri = None
    if path.suffix == ".gltf":
        uri = path.stem + ".bin"
        path.with_suffix(".bin").write_bytes(bytes(blob))
    else:
        g.set_binary_blob(bytes(blob))
    g.buffers.append(pygltflib.Buffer(byteLength=len(blob), uri=uri))
    g.save(str(path))
    return path


@pytest.mark.parametrize("mode", ["LINEAR", "CUBICSPLINE", "STEP"])
@pytest.mark.parametrize("suffix", [".glb", ".gltf"])
def test_gltf_motion_round_trips(body, rest, tmp_path, mode, suffix):
    walk = procedural_clip("walk", fps=30.0)
    again = load_motion(write_gltf(tmp_path / f"walk{suffix}", body, rest, walk, mode))
    assert again.num_frames == walk.num_frames and again.fps == 30.0
    assert limbs_apart(body, rest, walk, again) < 0.2
    np.testing.assert_allclose(again.root, walk.root, atol=0.01)


def as_vrm(path, key, out):
    """The file with names that say nothing, and VRM's word for which node is which bone."""
    document = pygltflib.GLTF2().load(str(path))
    bones = {}
    known = {"mixamorig:" + JOINT_MAPS["mixamo"][b]: v for b, v in JOINT_MAPS["vrm"].items()}
    for n, node in enumerate(document.nodes):
        if node.name in known:
            bones[known[node.name]] = n
            node.name = f"bone.{n}"
    # A name that another node has by right.
    document.nodes[0].name = "hips"
    pairs = {b: {"node": n} for b, n in bones.items()}
    listed = [{"bone": b, "node": n} for b, n in bones.items()]
    document.extensions = {key: {"humanoid": {"humanBones": listed if key == "VRM" else pairs}}}
    document.extensionsUsed = [key]
    if key == "VRMC_vrm_animation":
        document.skins = []
    document.save_binary(str(out))
    return out


@pytest.mark.parametrize(
    "key, name", [("VRM", "a.vrm"), ("VRMC_vrm", "a.vrm"), ("VRMC_vrm_animation", "a.vrma")]
)
def test_vrm_humanoid_bones_define_the_joints(body, rest, tmp_path, key, name):
    walk = procedural_clip("walk", fps=15.0)
    plain = write_gltf(tmp_path / "walk.glb", body, rest, walk)
    path = as_vrm(plain, key, tmp_path / name)
    again = load_motion(path)
    assert limbs_apart(body, rest, walk, again) < 0.2
    np.testing.assert_allclose(again.root, walk.root, atol=0.01)
    # The control: without its word nobody knows.
    document = pygltflib.GLTF2().load_binary(str(path))
    document.extensions = {}
    document.save_binary(str(path))
    with pytest.raises(MotionError, match="unknown joints"):
        load_motion(path)


@pytest.mark.parametrize("told", [3, {"hips": 3}, [{"bone": "hips"}], {"hips": {"node": 999}}])
def test_damaged_vrm_humanoid_data_is_refused(body, rest, tmp_path, told):
    path = write_gltf(tmp_path / "walk.glb", body, rest, procedural_clip("walk", fps=5.0))
    document = pygltflib.GLTF2().load(str(path))
    document.extensions = {"VRM": {"humanoid": {"humanBones": told}}}
    document.save_binary(str(path))
    with pytest.raises(MotionError, match=r"walk\.glb.*damaged"):
        load_motion(path)


def test_keys_in_compressed_buffers_explain_how_to_unpack(body, rest, tmp_path):
    path = write_gltf(tmp_path / "walk.glb", body, rest, procedural_clip("walk", fps=5.0))
    document = pygltflib.GLTF2().load(str(path))
    document.extensionsUsed = document.extensionsRequired = ["EXT_meshopt_compression"]
    document.save_binary(str(path))
    assert load_motion(path).num_frames > 2
    document.bufferViews[0].extensions = {"EXT_meshopt_compression": {}}
    document.save_binary(str(path))
    with pytest.raises(MotionError, match=r"EXT_meshopt_compression.*gltf-transform"):
        load_motion(path)


def test_skeleton_is_taken_from_the_largest_skin(body, rest, tmp_path):
    walk = procedural_clip("walk", fps=10.0)
    path = write_gltf(tmp_path / "walk.glb", body, rest, walk)
    document = pygltflib.GLTF2().load(str(path))
    document.skins.insert(0, pygltflib.Skin(joints=[3, 4]))
    document.save_binary(str(path))
    assert limbs_apart(body, rest, walk, load_motion(path)) < 0.2


def test_skeleton_with_collinear_hips_and_shoulders_is_refused(tmp_path):
    """Found by a fuzzer: a figure that lies, one hip above the other,
    in line with the shoulders."""
    document = json.loads(runpy.run_path(str(TESTS / "fuzz/readers.py"))["_gltf"](tmp_path))
    path = tmp_path / "a.gltf"
    path.write_text(json.dumps(document))
    load_motion(path)
    places = {n["name"]: n for n in document["nodes"]}
    for side, height in (("Left", 0.2), ("Right", -0.2)):
        places[f"{side}UpLeg"]["translation"] = [0.0, height, 0.0]
        places[f"{side}Leg"]["translation"] = [0.4, 0.0, 0.0]
        places[f"{side}Arm"]["translation"] = [0.0, 2 * height + 0.5, 0.0]
    path.write_text(json.dumps(document))
    with pytest.raises(MotionError, match="one line"):
        load_motion(path)


def test_linear_tracks_rotate_at_constant_speed_between_keys(body, rest, tmp_path):
    slow = procedural_clip("walk", fps=10.0)
    path = write_gltf(tmp_path / "walk.glb", body, rest, slow)
    from physxnet_jax.io._gltf_file import GltfFile

    file = GltfFile(path)
    times, fps = file.frame_times()
    assert fps == 10.0
    a, middle, b = file.world(np.array([times[3], times[3] + 0.05, times[4]]))[:, 5, :3, :3]
    whole, half = (Rotation.from_matrix(a.T / 1e-4 @ x).magnitude() for x in (b, middle))
    assert half == pytest.approx(0.5 * whole, rel=0.05)


def test_percent_encoded_buffer_names_are_read_inside_the_folder(body, rest, tmp_path):
    path = write_gltf(tmp_path / "walk.gltf", body, rest, procedural_clip("walk", fps=10.0))
    (tmp_path / "walk.bin").rename(tmp_path / "my walk.bin")
    text = path.read_text()
    path.write_text(text.replace("walk.bin", "my%20walk.bin"))
    assert load_motion(path).num_frames > 5
    (tmp_path / "secret.bin").write_bytes((tmp_path / "my walk.bin").read_bytes())
    inner = tmp_path / "inner"
    inner.mkdir()
    (inner / "walk.gltf").write_text(text.replace("walk.bin", "%2e%2e/secret.bin"))
    with pytest.raises(MotionError, match="outside its folder"):
        load_motion(inner / "walk.gltf")


def _last_key_at(document, binary, seconds):
    """Every track ends at this time; each frame would have a matrix for every node."""
    binary = bytearray(binary)
    for sampler in document["animations"][0]["samplers"]:
        accessor = document["accessors"][sampler["input"]]
        view = document["bufferViews"][accessor["bufferView"]]
        at = view.get("byteOffset", 0) + accessor.get("byteOffset", 0) + 4 * (accessor["count"] - 1)
        binary[at : at + 4] = np.float32(seconds).tobytes()
        accessor.pop("max", None)
    return document, bytes(binary)


BROKEN = {
    "no glTF": lambda d, b: (b"hello", None),
    "empty": lambda d, b: (b"", None),
    "truncated": lambda d, b: (None, b[: len(b) // 2]),
    "header alone": lambda d, b: (None, b[:12]),
    "circle": lambda d, b: (d["nodes"][5].update(children=[1]) or d, b),
    "own parent": lambda d, b: (d["nodes"][0].update(children=[0]) or d, b),
    "missing node": lambda d, b: (d["nodes"][0].update(children=[999]) or d, b),
    "huge count": lambda d, b: (d["accessors"][0].update(count=10**9) or d, b),
    "negative count": lambda d, b: (d["accessors"][0].update(count=-3) or d, b),
    "negative offset": lambda d, b: (d["bufferViews"][1].update(byteOffset=-64) or d, b),
    "view past its buffer": lambda d, b: (d["bufferViews"][1].update(byteLength=10**9) or d, b),
    "wild view": lambda d, b: (d["accessors"][0].update(bufferView=-1) or d, b),
    "wild type": lambda d, b: (d["accessors"][0].update(componentType=7) or d, b),
    "path out": lambda d, b: (d["buffers"][0].update(uri="../../secret.bin") or d, b),
    "absolute path": lambda d, b: (d["buffers"][0].update(uri="/etc/passwd") or d, b),
    "web address": lambda d, b: (d["buffers"][0].update(uri="https://example.org/a.bin") or d, b),
    "no base64": lambda d, b: (
        d["buffers"][0].update(uri="data:application/octet-stream;base64,!!") or d,
        b,
    ),
    "no animation": lambda d, b: (d.pop("animations") and d, b),
    "missing joint": lambda d, b: (d["skins"][0].update(joints=[1, 400]) or d, b),
    "scaled to nothing": lambda d, b: (d["nodes"][0].update(scale=[0, 0, 0]) or d, b),
    "NaN": lambda d, b: (d, b[:4] + np.float32(np.nan).tobytes() + b[8:]),
    "a day in a small file": lambda d, b: _last_key_at(d, b, 1e5),
    "version 1": lambda d, b: (d["asset"].update(version="1.0") or d, b),
}


@pytest.mark.release
@pytest.mark.parametrize("name", BROKEN)
def test_broken_gltf_files_are_refused(body, rest, tmp_path, name):
    (tmp_path / "secret.bin").write_bytes(b"secret" * 100)
    folder = tmp_path / "a" / "b"
    folder.mkdir(parents=True)
    path = write_gltf(folder / "walk.glb", body, rest, procedural_clip("walk", fps=10.0))
    blob = path.read_bytes()
    size = int.from_bytes(blob[12:16], "little")
    document, binary = json.loads(blob[20 : 20 + size]), blob[28 + size :]
    changed, kept = BROKEN[name](document, binary)
    if isinstance(changed, bytes):
        path.write_bytes(changed)
    elif changed is None:
        path.write_bytes(blob[: len(blob) // 2] if name == "truncated" else kept[:12])
    else:
        text = json.dumps(changed).encode()
        text += b" " * (-len(text) % 4)
        head = b"glTF" + (2).to_bytes(4, "little")
        chunks = len(text).to_bytes(4, "little") + b"JSON" + text
        chunks += len(kept).to_bytes(4, "little") + b"BIN\0" + kept
        path.write_bytes(head + (12 + len(chunks)).to_bytes(4, "little") + chunks)
    with pytest.raises(MotionError, match=r"walk\.glb") as error:
        load_motion(path)
    assert "secret" not in str(error.value).replace("secret.bin", "")


@pytest.mark.release
@settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck))
@given(at=st.floats(0, 1), byte=st.integers(0, 255), length=st.integers(1, 40))
def test_damaged_bytes_give_a_clip_or_a_motion_error(body, rest, tmp_path, at, byte, length):
    good = tmp_path / "good.glb"
    if not good.exists():
        write_gltf(good, body, rest, procedural_clip("walk", fps=5.0))
    blob = bytearray(good.read_bytes())
    # Mostly in the JSON, where meaning is.
    start = int(at * min(len(blob) - 1, 12_000))
    blob[start : start + length] = bytes([byte]) * length
    path = tmp_path / "bad.glb"
    path.write_bytes(blob)
    try:
        read_gltf(path)
    except MotionError as error:
        assert "bad.glb" in str(error)


def amass(body, rest, motion, layout="poses", z_up=True):
    """The motion as axis-angle poses of an SMPL-like figure in AMASS's layout."""
    from physxnet_jax.motion._amass import _FIGURE

    names = {s: b for b, s in JOINT_MAPS["smpl"].items()}
    world, shift = (np.asarray(x, np.float64) for x in clip_transforms(body, rest, motion))
    heads = np.asarray(body.joint_positions(rest)[0], np.float64)
    from physxnet_jax.body import align_global

    # A body whose limbs point as the figure's do at rest.
    place = {s: np.array(xyz) for s, _, xyz in _FIGURE}
    targets = {b: place[JOINT_MAPS["smpl"][e]] for b, e in LIMBS.items()}
    targets = {b: d / np.linalg.norm(d) for b, d in targets.items()}
    aligned = [r.as_matrix() for r in align_global(body, targets)]
    turn = Rotation.from_euler("X", 90 if z_up else 0, degrees=True).as_matrix()
    full = {}
    for s, _, _ in _FIGURE:
        j = body.joint_names.index(names[s])
        full[s] = turn @ world[:, j] @ aligned[j].T
    poses = []
    for s, parent, _ in _FIGURE:
        local = full[s] if parent is None else np.swapaxes(full[parent], 1, 2) @ full[s]
        poses.append(Rotation.from_matrix(local).as_rotvec())
    hips = np.einsum("fab,b->fa", world[:, 0], heads[0]) + shift[:, 0]
    flat = np.concatenate(poses, axis=1)
    out = {"trans": hips @ turn.T, "mocap_framerate": np.array(motion.fps)}
    if layout == "poses":
        hands = np.zeros((len(flat), 90))
        return out | {"poses": np.concatenate([flat, hands], axis=1), "betas": np.zeros(16)}
    out["mocap_frame_rate"] = out.pop("mocap_framerate")
    return out | {"root_orient": flat[:, :3], "pose_body": flat[:, 3:]}


@pytest.mark.parametrize("layout", ["poses", "pose_body"])
@pytest.mark.parametrize("z_up", [True, False])
def test_amass_motion_round_trips(body, rest, tmp_path, layout, z_up):
    walk = procedural_clip("walk", fps=15.0)
    path = tmp_path / "walk_poses.npz"
    np.savez(path, **amass(body, rest, walk, layout, z_up))
    again = load_motion(path)
    assert again.num_frames == walk.num_frames and again.fps == 15.0
    assert limbs_apart(body, rest, walk, again) < 0.2
    # The size of the figure is a guess: paths agree in direction and nearly in length.
    ours, theirs = (np.ptp(np.asarray(m.root)[:, 2]) for m in (walk, again))
    assert theirs == pytest.approx(ours, rel=0.1)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"poses": np.zeros((4, 30))}, "poses"),
        ({"poses": np.zeros((3, 156))}, "trans"),
        ({"poses": np.zeros((0, 156)), "trans": np.zeros((0, 3))}, "no frame"),
        ({"poses": np.full((4, 156), np.nan)}, "not finite"),
        ({"mocap_framerate": np.array(-1.0)}, "mocap_framerate"),
        ({"mocap_framerate": np.array(["x"])}, "mocap_framerate"),
        ({"poses": np.full((4, 156), "a")}, "poses are"),
        ({"poses": np.full((4, 156), None)}, "objects"),
        (
            {"poses": np.zeros((2_500_000, 66), np.int8), "trans": np.zeros((2_500_000, 3), "i1")},
            "cut the clip",
        ),
        ({"mocap_framerate": 1e-9}, "true rate|mocap_framerate"),
    ],
)
def test_broken_amass_files_are_refused(tmp_path, change, says):
    good = {"poses": np.zeros((4, 156)), "trans": np.zeros((4, 3)), "mocap_framerate": 30.0}
    path = tmp_path / "clip.npz"
    np.savez(path, **(good | change), allow_pickle=True)
    with pytest.raises(MotionError, match=says):
        load_motion(path, fps=30.0)
    np.savez(path, **good)
    assert load_motion(path).num_frames == 4


def document(folder, arrays, nodes, **more):
    """A glTF of arrays one after another: each with its type, and with what else is said of it."""
    blob, views, accessors = b"", [], []
    for values, kind, said, stride in arrays:
        data = values.tobytes()
        view = {"buffer": 0, "byteOffset": len(blob), "byteLength": len(data)}
        views.append(view | ({"byteStride": stride} if stride else {}))
        dtype = {"f4": 5126, "i2": 5122, "u1": 5121}[values.dtype.str[1:]]
        accessors.append(
            {"bufferView": len(views) - 1, "componentType": dtype, "type": kind} | said
        )
        blob += data + b"\0" * (-len(data) % 4)
    uri = "data:application/octet-stream;base64," + base64.b64encode(blob).decode()
    told = {
        "asset": {"version": "2.0"},
        "buffers": [{"byteLength": len(blob), "uri": uri}],
        "bufferViews": views,
        "accessors": accessors,
        "nodes": nodes,
    }
    path = folder / "a.gltf"
    path.write_text(json.dumps(told | more))
    return GltfFile(path)


def test_normalized_integer_and_strided_accessors_are_read(tmp_path):
    """The specification's 3.11: f = max(c / 127, -1) and the like; 3.6.2.4: strides."""
    short = np.array([[-32768, -32767, 16384, 32767]], "<i2")
    byte = np.array([[0, 51, 255, 128]], "|u1")
    rows = np.arange(24, dtype="<f4").reshape(3, 8)
    file = document(
        tmp_path,
        [
            (short, "VEC4", {"count": 1, "normalized": True}, None),
            (byte, "VEC4", {"count": 1, "normalized": True}, None),
            (byte, "VEC4", {"count": 1}, None),
            (rows, "VEC3", {"count": 3, "byteOffset": 8}, 32),
        ],
        [{"name": "a"}],
    )
    np.testing.assert_allclose(file.accessor(0), [[-1, -1, 16384 / 32767, 1]])
    np.testing.assert_allclose(file.accessor(1), byte / 255)
    np.testing.assert_array_equal(file.accessor(2), byte)
    np.testing.assert_array_equal(file.accessor(3), rows[:, 2:5])


def test_node_matrices_are_applied(tmp_path):
    turn = Rotation.from_euler("XYZ", [20, 50, -70], degrees=True).as_matrix()
    m = np.eye(4)
    m[:3, :3], m[:3, 3] = turn * [2.0, 3.0, 4.0], [5.0, 6.0, 7.0]
    nodes = [{"name": "a", "matrix": m.T.ravel().tolist(), "children": [1]}]
    nodes += [{"name": "b", "translation": [1.0, 1.0, 1.0]}]
    file = document(tmp_path, [(np.zeros((1, 3), "<f4"), "VEC3", {"count": 1}, None)], nodes)
    world = file.world()[0]
    np.testing.assert_allclose(world[0], m, atol=1e-12)
    np.testing.assert_allclose(world[1, :3, 3], turn @ [2.0, 3.0, 4.0] + [5, 6, 7], atol=1e-12)


def test_animation_starts_at_its_first_key(tmp_path):
    """Cut out of a longer one it begins at two seconds: nothing stands still until then."""
    times = (2.0 + np.arange(4) / 10.0).astype("<f4")
    places = np.array([[k, 0, 0] for k in range(4)], "<f4")
    animation = {
        "samplers": [{"input": 0, "output": 1}],
        "channels": [{"sampler": 0, "target": {"node": 0, "path": "translation"}}],
    }
    file = document(
        tmp_path,
        [(times, "SCALAR", {"count": 4}, None), (places, "VEC3", {"count": 4}, None)],
        [{"name": "a"}],
        animations=[animation],
    )
    at, fps = file.frame_times()
    assert fps == 10.0 and len(at) == 4
    np.testing.assert_allclose(file.world(at)[:, 0, 0, 3], [0, 1, 2, 3], atol=1e-5)


@pytest.mark.parametrize("leaves", [True, False])
def test_a_t_pose_in_the_first_key_is_dropped(body, rest, tmp_path, leaves):
    """The control: a person who stays in it isn't cut."""
    walk = procedural_clip("walk", fps=30.0)
    turns = np.array(walk.rotations)
    pose = np.asarray(t_pose(body))
    turns[: 1 if leaves else 12] = pose
    clip = make_motion(turns, np.asarray(walk.root), 30.0)
    path = write_gltf(tmp_path / "a.glb", body, rest, clip)
    again = load_motion(path)
    assert again.num_frames == walk.num_frames - leaves
    note = inspect_motion(path).reference
    assert ("dropped" in note) == leaves
    if leaves:
        kept = make_motion(turns[1:], np.asarray(walk.root)[1:], 30.0)
        assert limbs_apart(body, rest, kept, again) < 0.5


def test_the_longest_animation_is_read_and_others_are_named(body, rest, tmp_path):
    walk = procedural_clip("walk", fps=30.0)
    path = write_gltf(tmp_path / "a.glb", body, rest, walk)
    short = make_motion(np.asarray(walk.rotations)[:4], np.asarray(walk.root)[:4], 30.0)
    other = pygltflib.GLTF2().load(str(write_gltf(tmp_path / "b.glb", body, rest, short)))
    both = pygltflib.GLTF2().load(str(path))
    blob, more = both.binary_blob(), other.binary_blob()
    views, accessors = len(both.bufferViews), len(both.accessors)
    for view in other.bufferViews:
        view.byteOffset += len(blob)
        both.bufferViews.append(view)
    for accessor in other.accessors:
        accessor.bufferView += views
        both.accessors.append(accessor)
    for sampler in other.animations[0].samplers:
        sampler.input += accessors
        sampler.output += accessors
    both.animations[0].name, other.animations[0].name = "Walk", "Start"
    both.animations.insert(0, other.animations[0])
    both.buffers[0].byteLength = len(blob) + len(more)
    both.set_binary_blob(blob + more)
    both.save(str(path))
    assert load_motion(path).num_frames == walk.num_frames
    assert load_motion(f"{path}#Start").num_frames == 4
    assert load_motion(f"{path}#Walk").num_frames == walk.num_frames
    assert any("'Walk' is read" in n and "Start" in n for n in inspect_motion(path).notes)
    assert not any("is read" in n for n in inspect_motion(f"{path}#Start").notes)
    with pytest.raises(MotionError, match="no animation 'Run'; there are Start, Walk"):
        load_motion(f"{path}#Run")
