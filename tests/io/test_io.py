"""Writers read back by independent readers; broken files refused in a sentence."""

import dataclasses
import hashlib
import json
import os
import subprocess
import sys

import jax
import numpy as np
import pytest
import trimesh
from safetensors.numpy import load, save

from physxnet_jax.errors import FormatError, MeshError, WeightsError
from physxnet_jax.garment import load_garment, template
from physxnet_jax.io import AnimatedMesh, read_obj, read_pc2, write_clip, write_obj, write_pc2
from physxnet_jax.models import (
    fold_batch_norm,
    list_weights,
    load_predictor,
    read_card,
    save_predictor,
    with_mirror_tta,
)

QUAD = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"


@pytest.fixture
def clip():
    rng = np.random.default_rng(0)
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    uv = rng.uniform(size=(4, 2)).astype(np.float32)
    return [
        AnimatedMesh(
            "2020 shirt-x", rng.normal(size=(5, 4, 3)).astype(np.float32), faces, uv, faces
        ),
        AnimatedMesh("2020_shirt_x", rng.normal(size=(5, 4, 3)).astype(np.float32), faces),
    ]


def test_usd_preserves_rate_axis_unit_uv_normals_and_velocities(tmp_path, clip):
    usd = pytest.importorskip("pxr.Usd")
    from pxr import UsdGeom, UsdShade

    (path,) = write_clip(tmp_path / "a.usdc", clip, 24.0)
    stage = usd.Stage.Open(str(path))
    assert UsdGeom.GetStageUpAxis(stage) == "Y" and UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert stage.GetTimeCodesPerSecond() == 24.0
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0, 4)
    prims = [p for p in stage.Traverse() if p.IsA(UsdGeom.Mesh)]
    assert len(prims) == 2 and stage.GetDefaultPrim().GetName() == "Person"
    for m, prim in zip(clip, prims):
        mesh = UsdGeom.Mesh(prim)
        for k in range(5):
            np.testing.assert_allclose(
                np.asarray(mesh.GetPointsAttr().Get(k)), m.positions[k], atol=1e-6
            )
        np.testing.assert_allclose(mesh.GetDisplayColorAttr().Get()[0], m.colour, atol=1e-6)
        material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
        shader = UsdShade.Shader(material.ComputeSurfaceSource()[0])
        assert shader.GetIdAttr().Get() == "UsdPreviewSurface"
        colour = shader.GetInput("diffuseColor").Get()
        np.testing.assert_allclose(colour, m.colour, atol=1e-6)
        # Between frames, where motion blur looks, points lie between those of the frames.
        for k in (0, 2, 3):
            seen = mesh.ComputePointsAtTime(k + 0.5, usd.TimeCode(k))
            half = 0.5 * (m.positions[k] + m.positions[k + 1])
            np.testing.assert_allclose(np.asarray(seen), half, atol=1e-5)
        normals = np.asarray(mesh.GetNormalsAttr().Get(2))
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-5)
        np.testing.assert_array_equal(
            np.asarray(mesh.GetFaceVertexIndicesAttr().Get()), m.faces.ravel()
        )
    st = UsdGeom.PrimvarsAPI(prims[0]).GetPrimvar("st")
    np.testing.assert_allclose(
        np.asarray(st.Get())[np.asarray(st.GetIndices())],
        clip[0].uv[clip[0].uv_faces.ravel()],
        atol=1e-6,
    )


def test_pc2_and_obj_keep_the_vertex_order(tmp_path, clip):
    files = write_clip(tmp_path / "a.pc2", clip, 30.0)
    assert len(files) == 4
    np.testing.assert_array_equal(read_pc2(files[0]), clip[0].positions)
    mesh = trimesh.load(files[1], process=False, force="mesh", maintain_order=True)
    ours = read_obj(files[1])
    np.testing.assert_allclose(ours.vertices, clip[0].positions[0], atol=1e-5)
    np.testing.assert_allclose(mesh.triangles, clip[0].positions[0][clip[0].faces], atol=1e-5)
    np.testing.assert_allclose(ours.uv[ours.uv_faces], clip[0].uv[clip[0].uv_faces], atol=1e-5)


def test_npz_is_readable_without_pickle(tmp_path, clip):
    (path,) = write_clip(tmp_path / "a.npz", clip, 30.0)
    with np.load(path, allow_pickle=False) as data:
        np.testing.assert_array_equal(data["2020_shirt_x_positions"], clip[1].positions)


def test_shorter_sequence_removes_stale_frames_of_a_longer_one(tmp_path, clip):
    one = [dataclasses.replace(clip[0], name="a")]
    write_clip(tmp_path / "c.obj", one, 30.0)
    (tmp_path / "c_a_0099.obj").write_text("mine")
    short = [dataclasses.replace(one[0], positions=one[0].positions[:2])]
    write_clip(tmp_path / "c.obj", short, 30.0)
    left = sorted(p.name for p in tmp_path.glob("*.obj"))
    assert left == ["c_a_0000.obj", "c_a_0001.obj", "c_a_0099.obj"]


def test_invalid_file_name_characters_are_replaced(tmp_path, clip):
    odd = [dataclasses.replace(clip[0], name="coat/..\\a:b")]
    for suffix in (".pc2", ".obj", ".npz", ".usda", ".glb"):
        for path in write_clip(tmp_path / "in" / f"c{suffix}", odd, 30.0):
            assert path.parent == tmp_path / "in" and path.is_file()
    assert (tmp_path / "in/c_coat_.._a_b.pc2").is_file()


def test_unknown_extensions_and_truncated_caches_are_refused(tmp_path, clip):
    with pytest.raises(FormatError, match=r"\.usdc"):
        write_clip(tmp_path / "a.abc", clip, 30.0)
    write_pc2(tmp_path / "a.pc2", clip[0].positions)
    blob = (tmp_path / "a.pc2").read_bytes()
    (tmp_path / "b.pc2").write_bytes(blob[:-5])
    with pytest.raises(FormatError, match="truncated"):
        read_pc2(tmp_path / "b.pc2")
    ragged = [AnimatedMesh("x", clip[0].positions, np.array([[0, 1, 9]]))]
    with pytest.raises(Exception):  # noqa: B017
        write_clip(tmp_path / "c.usdc", ragged, 30.0)
    assert not list(tmp_path.glob(".part-*"))


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "both"),
        ("\0\0", "binary"),
        (QUAD, "both"),
        (QUAD + "f 1 2 9\n", ":9:"),
        (QUAD + "f 0 1 2\n", "from 1"),
        (QUAD + "f 1 2\n", "fewer than three"),
        (QUAD + "f 1 1 2\n", "fewer than three"),
        (QUAD + "f 1/9 2/1 3/1\n", "uv 9"),
        (QUAD.replace("1 1 0", "1 nan 0") + "f 1 2 3\n", "finite"),
        (QUAD.replace("1 1 0", "1 one 0") + "f 1 2 3\n", "numbers"),
    ],
)
def test_broken_obj_files_are_refused(tmp_path, text, says):
    path = tmp_path / "a.obj"
    path.write_text(text)
    with pytest.raises(FormatError, match=says):
        read_obj(path)


def test_quads_split_at_the_shorter_diagonal_and_negative_indices_work(tmp_path):
    path = tmp_path / "a.obj"
    path.write_text("v 0 0 0\nv 3 0 0\nv 4 1 0\nv 1 1 0\nf -4 -3 -2 -1\n")
    mesh = read_obj(path)
    assert mesh.count == 1 and len(mesh.faces) == 2
    assert {1, 3} <= set(mesh.faces[0]) and {1, 3} <= set(mesh.faces[1])


@pytest.mark.release
@pytest.mark.parametrize(("unit", "scale"), [("m", 1.0), ("cm", 0.01), ("dm", 0.1), ("mm", 0.001)])
def test_units_and_axes_are_detected(tmp_path, unit, scale):
    g = template("bottom")
    v = np.asarray(g.mesh.vertices) / scale
    write_obj(tmp_path / "y.obj", v, np.asarray(g.mesh.faces))
    turned = np.column_stack([v[:, 0], -v[:, 2], v[:, 1]])
    write_obj(tmp_path / "z.obj", turned, np.asarray(g.mesh.faces))
    for name, up in (("y", "Y"), ("z", "Z")):
        loaded, report = load_garment(tmp_path / f"{name}.obj")
        assert (report.unit, report.up, report.template) == (unit, up, "bottom")
        np.testing.assert_allclose(
            np.asarray(loaded.mesh.vertices), np.asarray(g.mesh.vertices), atol=2e-4
        )


@pytest.mark.release
@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("tee", "top"),
        ("longsleeve", "top"),
        ("pants", "bottom"),
        ("pants_f_tight", "bottom"),
        ("F_Dress_01", "dress"),
        ("helper_skirt", "dress"),
        ("Tank_Top_01", "top"),
    ],
)
def test_real_garments_load_on_the_body(data_dir, name, kind):
    garment, report = load_garment(data_dir / "garments" / f"{name}.obj")
    assert report.unit == "dm" and report.up == "Y" and report.template == kind
    assert report.topology["non_manifold_edges"] == 0
    assert np.isfinite(np.asarray(garment.skin)).all()
    from physxnet_jax.body import load_body
    from physxnet_jax.garment import clearance

    distance, _ = clearance(load_body().rest_mesh(), np.asarray(garment.mesh.vertices))
    # Even the trousers that cut into the body on purpose end up outside it.
    assert np.mean(distance < -1e-3) < 0.02


@pytest.mark.release
def test_meshes_far_from_the_body_are_refused(tmp_path):
    rng = np.random.default_rng(0)
    write_obj(tmp_path / "a.obj", rng.uniform(50, 60, (30, 3)), np.arange(30).reshape(10, 3))
    with pytest.raises(MeshError, match="no unit and up axis"):
        load_garment(tmp_path / "a.obj")
    with pytest.raises(MeshError, match=r"\.obj, \.glb"):
        load_garment(tmp_path / "a.fbx")


@pytest.mark.release
def test_loading_weights_draws_no_random_numbers():
    """As a fresh process has it: what is drawn is compiled first, which takes seconds."""
    code = "from physxnet_jax.models import load_predictor; load_predictor('nano')"
    completed = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        env={**os.environ, "JAX_LOG_COMPILES": "1"},
    )
    assert completed.returncode == 0, completed.stderr[-2000:]
    assert "Compiling jit(" in completed.stderr and "truncated_normal" not in completed.stderr


@pytest.mark.release
def test_packaged_weights_load_and_damage_is_detected(tmp_path):
    assert list_weights() == ["base", "nano", "paper", "small"]
    predictor = load_predictor("base")
    assert read_card("base")["model"]["inputs"]["family"] == "local"
    for other, says in (
        (fold_batch_norm(predictor), "folded"),
        (with_mirror_tta(predictor), "test-time augmentation"),
    ):
        with pytest.raises(WeightsError, match=says):
            save_predictor(tmp_path / "w", other, name="copy")
    save_predictor(tmp_path / "w", predictor, name="copy")
    again = load_predictor(tmp_path / "w")
    for a, b in zip(jax.tree.leaves(predictor.state), jax.tree.leaves(again.state)):
        np.testing.assert_array_equal(np.asarray(a), np.asarray(b))
    blob = bytearray((tmp_path / "w/weights.safetensors").read_bytes())
    blob[-1] ^= 1
    (tmp_path / "w/weights.safetensors").write_bytes(bytes(blob))
    with pytest.raises(WeightsError, match="damaged"):
        load_predictor(tmp_path / "w")
    # A parameter of another name isn't taken for the one that is in its place.
    tensors = load(bytes(blob))
    name = "encoder.2.norm.mean"
    tensors["encoder.2.norm.average"] = tensors.pop(name)
    renamed = save(tensors)
    (tmp_path / "w/weights.safetensors").write_bytes(renamed)
    text = (tmp_path / "w/card.json").read_text()
    card = json.loads(text) | {"sha256": hashlib.sha256(renamed).hexdigest()}
    (tmp_path / "w/card.json").write_text(json.dumps(card))
    with pytest.raises(WeightsError, match=f"{name} isn't there"):
        load_predictor(tmp_path / "w")
    (tmp_path / "w/weights.safetensors").write_bytes(bytes(blob))
    (tmp_path / "w/card.json").write_text(text)
    card = json.loads((tmp_path / "w/card.json").read_text())
    card |= {"sha256": hashlib.sha256(bytes(blob)).hexdigest(), "atlas": "0" * 16}
    (tmp_path / "w/card.json").write_text(json.dumps(card))
    with pytest.raises(WeightsError, match="atlas"):
        load_predictor(tmp_path / "w")
    for text in ("{", "[]"):
        (tmp_path / "w/card.json").write_text(text)
        with pytest.raises(WeightsError, match="damaged"):
            load_predictor(tmp_path / "w")
        with pytest.raises(WeightsError, match="not a card"):
            read_card(tmp_path / "w")
    with pytest.raises(WeightsError, match="base"):
        load_predictor("second")


def test_usd_stores_normals_extent_and_velocities_of_every_frame(tmp_path, clip):
    usd = pytest.importorskip("pxr.Usd")
    from pxr import UsdGeom

    (path,) = write_clip(tmp_path / "a.usdc", clip, 24.0, velocities=True)
    stage = usd.Stage.Open(str(path))
    prims = [p for p in stage.Traverse() if p.IsA(UsdGeom.Mesh)]
    (lean,) = write_clip(tmp_path / "b.usdc", clip, 24.0)
    stage_without = usd.Stage.Open(str(lean))
    assert not any(
        UsdGeom.Mesh(p).GetVelocitiesAttr().HasAuthoredValue()
        for p in stage_without.Traverse()
        if p.IsA(UsdGeom.Mesh)
    )
    for m, prim in zip(clip, prims, strict=True):
        mesh = UsdGeom.Mesh(prim)
        for k, x in enumerate(m.positions):
            extent = np.asarray(mesh.GetExtentAttr().Get(k))
            np.testing.assert_allclose(extent, [x.min(axis=0), x.max(axis=0)], atol=1e-6)
            a, b, c = (x[m.faces[0, i]] for i in range(3))
            # Vertex 1 has one face alone.
            n = np.cross(b - a, c - a)
            seen = np.asarray(mesh.GetNormalsAttr().Get(k))[1]
            np.testing.assert_allclose(seen, n / np.linalg.norm(n), atol=1e-5)
        last, before = (np.asarray(mesh.GetVelocitiesAttr().Get(k)) for k in (4, 3))
        # Nothing comes to a halt where a clip ends.
        np.testing.assert_allclose(last, before)
        np.testing.assert_allclose(before, 24.0 * (m.positions[4] - m.positions[3]), rtol=1e-4)


@pytest.mark.release
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_weights_and_cards_that_are_not_finite_are_refused(tmp_path, value):
    predictor = load_predictor("nano")
    folder = tmp_path / "w"
    save_predictor(folder, predictor, name="copy")
    blob, text = (folder / "weights.safetensors").read_bytes(), (folder / "card.json").read_text()
    assert load_predictor(folder).config == predictor.config
    for name in ("encoder.2.norm.mean", "encoder.2.conv.kernel"):
        tensors = load(blob)
        tensors[name] = tensors[name].copy()
        tensors[name].reshape(-1)[3] = value
        broken = save(tensors)
        (folder / "weights.safetensors").write_bytes(broken)
        card = json.loads(text) | {"sha256": hashlib.sha256(broken).hexdigest()}
        (folder / "card.json").write_text(json.dumps(card))
        with pytest.raises(WeightsError, match=f"{name} has values that aren't finite"):
            load_predictor(folder)
    (folder / "weights.safetensors").write_bytes(blob)
    card = json.loads(text)
    card["normalisation"]["velocity"] = value
    (folder / "card.json").write_text(json.dumps(card))
    for attempt in (read_card, load_predictor):
        with pytest.raises(WeightsError, match="isn't a number"):
            attempt(folder)
    for wrong in (0.0, -1.0, 1e39):
        card["normalisation"]["velocity"] = 1.0
        card["normalisation"]["offset"]["top"] = wrong
        (folder / "card.json").write_text(json.dumps(card))
        with pytest.raises(WeightsError, match="normalisation by top"):
            load_predictor(folder)
