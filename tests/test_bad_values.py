"""Numbers and structures that readers must refuse or survive, each found in a file somebody made.

Warnings are errors here: what overflows on the way to an answer is found too.
"""

import json
import pathlib
import runpy

import numpy as np
import pytest

from physxnet_jax.data import open_dataset, read_sequence, read_times, write_action, write_garment
from physxnet_jax.data._store import write_offsets
from physxnet_jax.dressing import load_scene, read_character
from physxnet_jax.errors import FormatError, MotionError, PhysXNetError, WeightsError
from physxnet_jax.garment import square_sheet
from physxnet_jax.io import read_mesh, read_obj
from physxnet_jax.models import read_card, weights_size
from physxnet_jax.motion import (
    load_motion,
    make_motion,
    read_amc,
    read_bvh,
    read_joint_map,
)

_SAMPLES = runpy.run_path(str(pathlib.Path(__file__).with_name("samples.py")))
bvh = _SAMPLES["standing_bvh"]
_FUZZ = runpy.run_path(str(pathlib.Path(__file__).with_name("fuzz") / "readers.py"))


def test_unmodified_reference_figure_is_read(tmp_path):
    (tmp_path / "a.bvh").write_text(bvh())
    assert load_motion(tmp_path / "a.bvh").num_frames == 2, "the T-pose is none"
    (tmp_path / "a.bvh").write_text(bvh(legs=-0.4))
    assert load_motion(tmp_path / "a.bvh").num_frames == 2


@pytest.mark.parametrize("far", [1e10, 1e17, 1e200, 1e308])
@pytest.mark.parametrize(
    "where",
    ["root", "legs", "Spine", "LeftUpLeg", "LeftArm", "LeftHand"],
)
def test_joints_out_of_range_are_refused(tmp_path, where, far):
    changed = {"root": (far, far, far)} if where == "root" else {}
    changed |= {"legs": -far} if where == "legs" else {}
    if not changed:
        changed = {"offsets": {where: (far, far, far)}}
    (tmp_path / "a.bvh").write_text(bvh(**changed))
    with pytest.raises(MotionError, match=r"units away|out of range|length|legs"):
        load_motion(tmp_path / "a.bvh")


@pytest.mark.parametrize("length", [0, 1e-200, 1e-320])
def test_legs_without_length_are_refused(tmp_path, length):
    (tmp_path / "a.bvh").write_text(bvh(legs=length))
    with pytest.raises(MotionError, match="legs"):
        load_motion(tmp_path / "a.bvh")


def test_bvh_with_only_a_byte_order_mark_is_refused_as_empty(tmp_path):
    (tmp_path / "a.bvh").write_bytes(b"\xef\xbb\xbf\n")
    with pytest.raises(MotionError, match="empty"):
        read_bvh(tmp_path / "a.bvh")


def test_asf_bone_lengths_out_of_range_are_refused(tmp_path):
    asf, amc = _FUZZ["ASF"], _FUZZ["AMC"]
    (tmp_path / "a.amc").write_text(amc)
    (tmp_path / "a.asf").write_text(asf)
    read_amc(tmp_path / "a.amc", tmp_path / "a.asf")
    (tmp_path / "a.asf").write_text(asf.replace("length 2", "length 1e308"))
    with pytest.raises(MotionError, match="out of range"):
        read_amc(tmp_path / "a.amc", tmp_path / "a.asf")


@pytest.mark.parametrize(
    "node",
    [
        {"translation": [1e200, 0, 0]},
        {"translation": [0, 1e11, 0]},
        {"scale": [1e200, 1e200, 1e200]},
        {"rotation": [1e200, 1e200, 1e200, 1e200]},
        {"matrix": [1e200, 0, 0, 0, 0, 1e200, 0, 0, 0, 0, 1e200, 0, 0, 0, 0, 1]},
    ],
)
def test_gltf_node_transforms_out_of_range_are_refused(tmp_path, node):
    document = json.loads(_FUZZ["_gltf"](tmp_path))
    for n in (1, 2, 3):
        document["nodes"][n] = {**document["nodes"][n], **node}
        if "matrix" in node:
            del document["nodes"][n]["translation"]
    (tmp_path / "a.gltf").write_text(json.dumps(document))
    with pytest.raises(MotionError):
        load_motion(tmp_path / "a.gltf")


def test_accumulated_node_scales_out_of_range_are_refused(tmp_path):
    document = json.loads(_FUZZ["_gltf"](tmp_path))
    for node in document["nodes"]:
        node["scale"] = [1e8, 1e8, 1e8]
    (tmp_path / "a.gltf").write_text(json.dumps(document))
    with pytest.raises(MotionError, match="too far away"):
        load_motion(tmp_path / "a.gltf")


@pytest.mark.parametrize("nodes", [None, [], 5])
def test_gltf_without_nodes_is_refused(tmp_path, nodes):
    document = json.loads(_FUZZ["_gltf"](tmp_path)) | {"nodes": nodes}
    (tmp_path / "a.gltf").write_text(json.dumps(document))
    with pytest.raises(PhysXNetError):
        load_motion(tmp_path / "a.gltf")


def test_duplicate_joints_in_a_skin_are_refused(tmp_path):
    document = json.loads(_FUZZ["_skin"](tmp_path))
    (tmp_path / "a.gltf").write_text(json.dumps(document))
    read_mesh(tmp_path / "a.gltf")
    document["skins"][0]["joints"] = [0] * len(document["skins"][0]["joints"])
    (tmp_path / "a.gltf").write_text(json.dumps(document))
    with pytest.raises(FormatError, match="twice"):
        read_mesh(tmp_path / "a.gltf")


POSES, TRANS = np.zeros((3, 66)), np.zeros((3, 3))


@pytest.mark.parametrize(
    "arrays",
    [
        {"poses": POSES + 1e200, "trans": TRANS},
        {"poses": POSES.astype(np.longdouble), "trans": TRANS},
        {"poses": POSES, "trans": TRANS + 1e200},
        {"poses": POSES.astype(complex), "trans": TRANS},
        {"root_orient": POSES[:, :3].astype("M8[s]"), "pose_body": POSES[:, 3:], "trans": TRANS},
    ],
)
def test_invalid_amass_poses_are_refused(tmp_path, arrays):
    np.savez(tmp_path / "a.npz", mocap_framerate=30.0, poses=POSES, trans=TRANS)
    load_motion(tmp_path / "a.npz")
    np.savez(tmp_path / "a.npz", mocap_framerate=30.0, **arrays)
    with pytest.raises(MotionError):
        load_motion(tmp_path / "a.npz")


TURNS = np.tile([1.0, 0.0, 0.0, 0.0], (2, 31, 1))


def test_large_quaternions_are_normalized():
    """Up to a length that no rotation has."""
    for length in (1e-5, 1e5):
        motion = make_motion(length * TURNS, np.zeros((2, 3)), 30.0)
        np.testing.assert_allclose(motion.rotations, TURNS, atol=1e-7)
    with pytest.raises(MotionError, match="huge quaternion"):
        make_motion(1e200 * TURNS, np.zeros((2, 3)), 30.0)


@pytest.mark.parametrize(
    "arrays",
    [
        {"rotations": TURNS.astype(complex)},
        {"rotations": TURNS.astype(np.longdouble)},
        {"rotations": TURNS.astype("M8[s]")},
        {
            "rotations": np.zeros((4_000_000, 2, 4), np.uint8),
            "root": np.zeros((4_000_000, 3), "u1"),
        },
    ],
)
def test_motion_archives_with_invalid_arrays_are_refused(tmp_path, arrays):
    good = {"rotations": TURNS, "root": np.zeros((2, 3)), "fps": 30.0}
    np.savez_compressed(tmp_path / "a.npz", **good | arrays)
    with pytest.raises(MotionError):
        load_motion(tmp_path / "a.npz")


TRIANGLE = np.array([[0, 0, 0], [1, 0, 0], [0, 1.7, 0]])
MOVING = np.stack([TRIANGLE, TRIANGLE + 0.1])


@pytest.mark.parametrize(
    ("positions", "fps"),
    [
        (MOVING.astype(np.float16), 30.0),
        (MOVING, np.array([30.0])),
        (MOVING, 24),
        (np.round(100 * MOVING).astype(np.uint8), 30.0),
    ],
)
def test_character_arrays_of_any_numeric_type_are_read(tmp_path, positions, fps):
    np.savez(tmp_path / "a.npz", positions=positions, faces=np.array([[0, 1, 2]]), fps=fps)
    person, _, _ = read_character(tmp_path / "a.npz", fps=60.0)[:3]
    assert 3 <= len(person.positions) <= 4
    # Between its frames, not around the end of its type.
    assert np.diff(person.positions[:, 0, 0]).min() >= 0


@pytest.mark.parametrize(
    "arrays",
    [
        {"fps": 5e-324},
        {"fps": np.timedelta64(30, "s")},
        {"fps": np.array([30.0, 30.0])},
        {"positions": MOVING.astype("m8[s]")},
        {"positions": MOVING.astype(np.longdouble)},
    ],
)
def test_character_archives_with_invalid_arrays_are_refused(tmp_path, arrays):
    good = {"positions": MOVING, "faces": np.array([[0, 1, 2]]), "fps": 30.0}
    np.savez(tmp_path / "a.npz", **good | arrays)
    with pytest.raises(FormatError):
        read_character(tmp_path / "a.npz", frames=2)


def test_invalid_file_names_are_reported_as_missing(tmp_path):
    long = "a" * 300
    (tmp_path / "a.obj").write_text(f"mtllib {long}\n{_FUZZ['OBJ']}")
    assert len(read_obj(tmp_path / "a.obj").faces) == 4
    for word in (f"{long}.obj", "nul\0.obj"):
        with pytest.raises(FormatError, match="no such file"):
            read_mesh(tmp_path / word)
    document = json.loads(_FUZZ["_gltf"](tmp_path))
    document["buffers"][0]["uri"] = long
    (tmp_path / "a.gltf").write_text(json.dumps(document))
    with pytest.raises(MotionError, match="missing"):
        load_motion(tmp_path / "a.gltf")


def test_repeated_references_are_read_once(tmp_path):
    """Options, libraries and images that come again and again cost no square of them."""
    (tmp_path / "red.png").write_bytes(_FUZZ["_png"](tmp_path))
    options = "-a " * 20_000
    library = "".join(f"newmtl m{k}\nmap_Kd red.png\n" for k in range(50))
    (tmp_path / "a.mtl").write_text(f"{library}newmtl last\nmap_Kd {options}red.png\n")
    uses = "".join(f"usemtl m{k}\nf 1 2 3\n" for k in range(50))
    text = "mtllib a.mtl\n" * 2000 + "v 0 0 0\nv 1 0 0\nv 0 1 0\n" + uses
    (tmp_path / "a.obj").write_text(text)
    materials = read_obj(tmp_path / "a.obj").polygons.materials
    assert len({id(m.texture.data) for m in materials}) == 1


@pytest.mark.parametrize("text", ["a = " + "[" * 5000, "a = " + "9" * 5000])
def test_unparsable_toml_files_are_refused(tmp_path, text):
    (tmp_path / "a.toml").write_text(text)
    with pytest.raises(MotionError):
        read_joint_map(tmp_path / "a.toml")
    with pytest.raises(FormatError):
        load_scene(tmp_path / "a.toml")


@pytest.mark.release
@pytest.mark.parametrize(
    "line",
    [
        f"fps = {10**400}",
        f"start = {10**400}",
        'joint_map = "\\u0000"',
        f"[effects.air]\nturbulence = {10**400}",
        "[effects.air]\nwind = [[1.0], [2.0], [3.0]]",
        f"[effects.{'x' * 5000}]",
    ],
)
def test_invalid_scene_settings_are_refused(tmp_path, line):
    (tmp_path / "a.toml").write_text(f'motion = "walk"\n{line}\n')
    with pytest.raises(PhysXNetError) as told:
        load_scene(tmp_path / "a.toml")
    assert len(str(told.value)) < 1500


def test_long_errors_keep_their_start_and_their_advice():
    text = str(MotionError.at("a.bvh", 3, "x" * 10_000, "Export it again"))
    assert text.startswith("a.bvh:3: xxx") and text.endswith("Export it again") and len(text) < 1300


@pytest.fixture
def dataset(tmp_path):
    """An action with a sheet."""
    root, sheet = tmp_path / "set", square_sheet(3)
    open_dataset(root, {"fps": 30})
    write_garment(root, "top", np.asarray(sheet.mesh.vertices), np.asarray(sheet.mesh.faces))
    write_action(root / "walk", load_motion("walk"), "train")
    frames = load_motion("walk").num_frames
    write_offsets(root / "walk", "top", np.zeros((frames, 9, 3), np.float32), {"finite": True})
    assert read_sequence(root / "walk").offsets["top"].shape == (frames, 9, 3)
    return root


@pytest.mark.parametrize(
    "change",
    [
        {"order": np.full(9, 99)},
        {"order": np.zeros(9, int)},
        {"parents": np.full((9, 10), 99)},
        {"parents": np.zeros(9, int)},
        {"weights": np.full((9, 10), np.nan)},
        {"weights": np.full((9, 10), "x")},
        {"vertices": np.full((9, 3), "x")},
        {"faces": np.full((2, 3), -1)},
    ],
)
def test_damaged_garment_of_a_dataset_is_reported(dataset, change):
    path = dataset / "garments/top.npz"
    with np.load(path) as told:
        np.savez(path, **{**told, **change})
    with pytest.raises(FormatError, match="damaged"):
        read_sequence(dataset / "walk")


@pytest.mark.parametrize(
    "shape", [[3, 9, 10_000_000], [3, 4, 60], [3, 9], [10_000, 10_000, 10_000]]
)
def test_arrays_with_a_false_shape_are_reported(dataset, shape):
    path = dataset / "walk/top/zarr.json"
    told = json.loads(path.read_text())
    told["shape"] = shape
    path.write_text(json.dumps(told))
    with pytest.raises(FormatError, match="damaged"):
        read_sequence(dataset / "walk")


@pytest.mark.parametrize("text", ["[" * 100_000, "{}", "5", '{"attributes": 3}', "\xff"])
def test_damaged_metadata_files_are_reported(dataset, text):
    for name in ("walk/top/zarr.json", "walk/action.json"):
        path = dataset / name
        before = path.read_bytes()
        path.write_bytes(text.encode("latin-1"))
        with pytest.raises(FormatError):
            read_sequence(dataset / "walk")
        path.write_bytes(before)
    (dataset / "times").mkdir()
    (dataset / "times/walk-top.json").write_bytes(text.encode("latin-1"))
    assert read_times(dataset) in ([], [{}], [{"attributes": 3}])
    if text != "{}":
        (dataset / "card.json").write_bytes(text.encode("latin-1"))
        with pytest.raises(WeightsError):
            weights_size(dataset)


def test_weights_size_of_an_invalid_card_is_refused(tmp_path):
    (tmp_path / "card.json").write_text(json.dumps({"name": 5}))
    assert read_card(tmp_path) == {"name": 5}
    with pytest.raises(WeightsError, match="no such file"):
        weights_size(tmp_path)


@pytest.mark.parametrize(
    "text",
    [
        'def "a" {\n' * 60_000 + "}\n" * 60_000,
        'def "p" { custom double3 q = ' + "(" * 30_000,
        'def "p0" {}\n'
        + "".join(
            f'def "p{k}" {{ def "a" (prepend references = </p{k - 1}>) {{}}'
            f' def "b" (prepend references = </p{k - 1}>) {{}} }}\n'
            for k in range(1, 40)
        ),
    ],
    ids=["nested", "brackets", "references"],
)
def test_oversized_usd_stages_are_refused_before_reading(tmp_path, text, monkeypatch):
    pytest.importorskip("pxr")
    monkeypatch.setattr("physxnet_jax.io._usd_trial._SECONDS", 5.0)
    (tmp_path / "a.usda").write_text(f"#usda 1.0\n{text}")
    with pytest.raises(FormatError):
        read_mesh(tmp_path / "a.usda")
