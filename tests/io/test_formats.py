"""MDD, glTF and OBJ sequences, read back by readers that share no code with the writers."""

import dataclasses
import json
import pathlib
import struct

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings, strategies as st

from physxnet_jax.cli import main
from physxnet_jax.errors import FormatError, PhysXNetError
from physxnet_jax.io import AnimatedMesh, read_mdd, write_clip, write_mdd
from physxnet_jax.io._gltf import MAX_FRAMES


@pytest.fixture
def clip():
    """A square whose halves don't meet on the chart, and a tetrahedron."""
    rng = np.random.default_rng(0)
    square = np.array([[0, 1, 2], [0, 2, 3]])
    uv = rng.uniform(size=(6, 2)).astype(np.float32)
    tetra = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
    return [
        AnimatedMesh(
            "shirt",
            rng.normal(size=(5, 4, 3)).astype(np.float32),
            square,
            uv,
            np.arange(6).reshape(2, 3),
            (0.8, 0.1, 0.2),
        ),
        AnimatedMesh("body", rng.normal(size=(5, 4, 3)).astype(np.float32), tetra),
    ]


def read_glb(path: pathlib.Path) -> tuple[dict, bytes]:
    """The JSON and the buffer of a binary glTF, as the specification lays them out."""
    blob = path.read_bytes()
    magic, version, length = struct.unpack_from("<4sII", blob)
    assert magic == b"glTF" and version == 2 and length == len(blob)
    size, kind = struct.unpack_from("<I4s", blob, 12)
    assert kind == b"JSON"
    document = json.loads(blob[20 : 20 + size])
    start = 20 + size
    size, kind = struct.unpack_from("<I4s", blob, start)
    assert kind == b"BIN\0"
    return document, blob[start + 8 : start + 8 + size]


def accessor(document: dict, blob: bytes, number: int) -> np.ndarray:
    a = document["accessors"][number]
    view = document["bufferViews"][a["bufferView"]]
    columns = {"SCALAR": 1, "VEC2": 2, "VEC3": 3}[a["type"]]
    dtype = {5125: "<u4", 5126: "<f4"}[a["componentType"]]
    start = view.get("byteOffset", 0) + a.get("byteOffset", 0)
    data = np.frombuffer(blob, dtype, a["count"] * columns, start).reshape(-1, columns)
    np.testing.assert_allclose(data.min(axis=0), a["min"], rtol=1e-6)
    np.testing.assert_allclose(data.max(axis=0), a["max"], rtol=1e-6)
    return data


def test_gltf_morph_targets_reproduce_the_clip(tmp_path, clip):
    pytest.importorskip("pygltflib")
    (path,) = write_clip(tmp_path / "a.glb", clip, 25.0)
    document, blob = read_glb(path)
    (animation,) = document["animations"]
    assert [c["target"]["path"] for c in animation["channels"]] == ["weights"] * 2
    sampler = animation["samplers"][0]
    times = accessor(document, blob, sampler["input"]).ravel()
    np.testing.assert_allclose(times, np.arange(5) / 25.0, atol=1e-6)
    weights = accessor(document, blob, sampler["output"]).reshape(5, 4)
    for m, node in zip(clip, document["nodes"], strict=True):
        assert node["name"] == m.name
        (primitive,) = document["meshes"][node["mesh"]]["primitives"]
        index = accessor(document, blob, primitive["indices"]).reshape(-1, 3)
        base = accessor(document, blob, primitive["attributes"]["POSITION"])
        moved = [accessor(document, blob, t["POSITION"]) for t in primitive["targets"]]
        for k in range(5):
            x = base + sum(w * d for w, d in zip(weights[k], moved, strict=True))
            # Corner by corner: seams double vertices.
            np.testing.assert_allclose(x[index], m.positions[k][m.faces], atol=1e-5)
        normals = accessor(document, blob, primitive["attributes"]["NORMAL"])
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-5)
        material = document["materials"][primitive["material"]]
        colour = material["pbrMetallicRoughness"]["baseColorFactor"]
        np.testing.assert_allclose(colour, [*m.colour, 1.0], atol=1e-6)
        if m.uv is not None:
            chart = accessor(document, blob, primitive["attributes"]["TEXCOORD_0"])
            expected = m.uv[m.uv_faces] * [1, -1] + [0, 1]
            np.testing.assert_allclose(chart[index], expected, atol=1e-6)


def test_trimesh_reads_the_gltf_meshes(tmp_path, clip):
    pytest.importorskip("pygltflib")
    (path,) = write_clip(tmp_path / "a.glb", clip, 25.0)
    scene = trimesh.load(path)
    assert set(scene.geometry) == {"shirt", "body"}
    body = scene.geometry["body"]
    np.testing.assert_allclose(
        np.asarray(body.vertices)[body.faces], clip[1].positions[0][clip[1].faces], atol=1e-5
    )


def test_gltf_refuses_clips_with_too_many_frames(tmp_path, monkeypatch, capsys):
    long = np.zeros((MAX_FRAMES + 1, 3, 3), np.float32)
    with pytest.raises(FormatError, match="too many for glTF"):
        write_clip(tmp_path / "a.glb", [AnimatedMesh("a", long, np.array([[0, 1, 2]]))], 30.0)
    assert not (tmp_path / "a.glb").exists()
    # And before anything is computed.
    monkeypatch.setattr("physxnet_jax.io._gltf.MAX_FRAMES", 20)
    monkeypatch.setattr("physxnet_jax.cli._dress.dress", None)
    assert main(["dress", "walk", "--wear", "bottom", "-o", str(tmp_path / "b.html")]) == 2
    assert "too many for glTF" in capsys.readouterr().err


def test_one_frame_gltf_has_no_animation(tmp_path, clip):
    pytest.importorskip("pygltflib")
    still = [AnimatedMesh(m.name, m.positions[:1], m.faces) for m in clip]
    (path,) = write_clip(tmp_path / "a.glb", still, 30.0)
    document, _ = read_glb(path)
    assert not document.get("animations")


def test_mdd_layout_matches_its_specification(tmp_path, clip):
    files = write_clip(tmp_path / "a.mdd", clip, 24.0)
    assert [f.name for f in files] == [
        "a_shirt.mdd",
        "a_shirt.obj",
        "a_body.mdd",
        "a_body.obj",
    ]
    blob = files[0].read_bytes()
    assert struct.unpack_from(">ii", blob) == (5, 4)
    np.testing.assert_allclose(struct.unpack_from(">5f", blob, 8), np.arange(5) / 24, atol=1e-6)
    first = struct.unpack_from(">3f", blob, 8 + 4 * 5)
    np.testing.assert_allclose(first, clip[0].positions[0, 0], atol=1e-6)
    positions, times = read_mdd(files[0])
    np.testing.assert_array_equal(positions, clip[0].positions)
    assert times[-1] == pytest.approx(4 / 24)


def test_obj_sequences_have_one_file_per_frame(tmp_path, clip):
    files = write_clip(tmp_path / "a.obj", clip, 24.0)
    assert len(files) == 10 and files[3].name == "a_shirt_0003.obj"
    mesh = trimesh.load(files[8], process=False, force="mesh", maintain_order=True)
    np.testing.assert_allclose(mesh.vertices, clip[1].positions[3], atol=1e-5)


@settings(max_examples=60, deadline=None)
@given(blob=st.binary(max_size=64), cut=st.integers(0, 120))
def test_broken_mdd_files_are_refused(tmp_path_factory, blob, cut):
    folder = tmp_path_factory.getbasetemp()
    path = folder / "broken.mdd"
    path.write_bytes(blob)
    try:
        positions, times = read_mdd(path)
        assert 8 + 4 * len(times) + 4 * positions.size == len(blob)
    except FormatError as error:
        assert "MDD" in str(error)
    write_mdd(path, np.ones((3, 3, 3), np.float32), 30.0)
    whole = path.read_bytes()
    if cut < len(whole):
        path.write_bytes(whole[:cut])
        with pytest.raises(FormatError):
            read_mdd(path)


def test_oversized_mdd_headers_are_refused_as_truncated(tmp_path):
    path = tmp_path / "huge.mdd"
    path.write_bytes(struct.pack(">ii", 2**31 - 1, 2**31 - 1) + b"\0" * 64)
    with pytest.raises(FormatError, match="truncated"):
        read_mdd(path)


def area_normals(x, faces):
    n = np.zeros_like(x)
    for k in range(3):
        a, b, c = (x[faces[:, (k + i) % 3]] for i in range(3))
        np.add.at(n, faces[:, k], np.cross(b - a, c - a))
    return n / np.linalg.norm(n, axis=1, keepdims=True)


def test_gltf_morph_targets_include_the_normals_of_each_frame(tmp_path, clip):
    """Morph targets add to the mesh's normals as they do to its points."""
    pytest.importorskip("pygltflib")
    (path,) = write_clip(tmp_path / "a.glb", clip, 25.0)
    document, blob = read_glb(path)
    for m, node in zip(clip, document["nodes"], strict=True):
        (primitive,) = document["meshes"][node["mesh"]]["primitives"]
        base = accessor(document, blob, primitive["attributes"]["NORMAL"])
        # At seams of the chart vertices are doubled.
        places = accessor(document, blob, primitive["attributes"]["POSITION"])
        rows = [int(np.flatnonzero((m.positions[0] == p).all(axis=1))[0]) for p in places]
        moved = [accessor(document, blob, t["NORMAL"]) for t in primitive["targets"]]
        for k, x in enumerate(m.positions):
            seen = base + (moved[k - 1] if k else 0.0)
            np.testing.assert_allclose(seen, area_normals(x, m.faces)[rows], atol=1e-5)


@pytest.mark.parametrize("suffix", ["npz", "obj", "pc2", "mdd", "glb"])
def test_meshes_of_one_name_are_all_written(tmp_path, clip, suffix):
    """As two people in a shirt; names may differ in what file names can't hold alone."""
    meshes, fps = clip, 30.0
    a, b = (dataclasses.replace(meshes[0], name=n) for n in ("a:b", "a_b"))
    written = write_clip(tmp_path / f"two.{suffix}", [a, a, b], fps)
    assert len(set(written)) == len(written) and all(p.exists() for p in written)
    if suffix == "npz":
        with np.load(written[0], allow_pickle=False) as file:
            assert {"a:b_positions", "a:b_2_positions", "a_b_3_positions"} <= set(file.files)
    elif suffix != "glb":
        assert len([p for p in written if p.suffix == f".{suffix}"]) % 3 == 0


@pytest.mark.parametrize("suffix", ["npz", "obj", "glb", "usda", "pc2"])
def test_clips_that_are_none_are_refused(tmp_path, clip, suffix):
    meshes, fps = clip, 30.0
    path = tmp_path / f"a.{suffix}"
    for rate in (0.0, -30.0, float("nan")):
        with pytest.raises(PhysXNetError, match=r"fps is .*, expected a positive number"):
            write_clip(path, meshes, rate)
    short = dataclasses.replace(meshes[0], positions=meshes[0].positions[:1])
    for bad in (
        [],
        [meshes[0], short],
        [dataclasses.replace(short, positions=short.positions[:0])],
    ):
        with pytest.raises(FormatError, match="frames"):
            write_clip(path, bad, fps)
    assert not list(tmp_path.iterdir())
