"""Rigged persons: bind poses, inspection, and files that keep the person and add garments."""

import pathlib
import runpy

import numpy as np
import pygltflib
import pytest
from scipy.spatial.transform import Rotation

import physxnet_jax as px
from physxnet_jax.dressing import is_character, read_character
from physxnet_jax.errors import FormatError, MotionError
from physxnet_jax.io import AnimatedMesh, GltfFile, rest_matrices
from physxnet_jax.motion import load_motion, procedural_clip

rigged_person = runpy.run_path(str(pathlib.Path(__file__).parents[1] / "samples.py"))[
    "rigged_person"
]


def posed(path, out, seed, largest=25.0, only=None):
    """The same rig with its nodes turned by random angles up to `largest` degrees."""
    rng = np.random.default_rng(seed)
    document = pygltflib.GLTF2().load(str(path))
    for n in document.skins[0].joints:
        if only is None or document.nodes[n].name in only:
            turn = Rotation.from_rotvec(np.radians(largest) * rng.uniform(-0.5, 0.5, 3))
            document.nodes[n].rotation = turn.as_quat().tolist()
    document.save_binary(str(out))
    return out


@pytest.fixture(scope="module")
def hero(body, tmp_path_factory):
    return rigged_person(tmp_path_factory.mktemp("rig") / "hero.glb", body)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_rigs_saved_in_a_pose_move_as_those_saved_in_their_bind_pose(hero, tmp_path, seed):
    walk = procedural_clip("walk", fps=15.0)[:8]
    leaning = posed(hero, tmp_path / "leaning.glb", seed)
    assert rest_matrices(GltfFile(hero)) is None and rest_matrices(GltfFile(leaning)) is not None
    plain, other = (read_character(p, motion=walk) for p in (hero, leaning))
    np.testing.assert_allclose(other.mesh.positions, plain.mesh.positions, atol=2e-5)
    np.testing.assert_allclose(other.bind, plain.bind, atol=2e-5)


def test_the_static_pose_of_a_leaning_rig_is_another_one(hero, tmp_path):
    """The control: without its bind pose, the rig would lean."""
    leaning = GltfFile(posed(hero, tmp_path / "leaning.glb", 0))
    rest = rest_matrices(leaning)
    assert np.abs(rest[..., :3, 3] - leaning.world()[0, :, :3, 3]).max() > 0.05


def test_bind_matrices_that_change_the_bones_are_not_used(hero, tmp_path):
    document = pygltflib.GLTF2().load(str(hero))
    at = document.accessors[document.skins[0].inverseBindMatrices].bufferView
    view = document.bufferViews[at]
    blob = bytearray(document.binary_blob())
    part = slice(view.byteOffset, view.byteOffset + view.byteLength)
    matrices = np.frombuffer(bytes(blob[part]), np.float32).reshape(-1, 4, 4).copy()
    matrices[3:, 3, :3] *= np.linspace(1.0, 3.0, len(matrices) - 3)[:, None]
    blob[part] = matrices.tobytes()
    document.set_binary_blob(bytes(blob))
    document.save_binary(str(tmp_path / "odd.glb"))
    assert rest_matrices(GltfFile(tmp_path / "odd.glb")) is None


def test_inspection_of_a_rig_says_that_it_is_a_person(hero, tmp_path):
    found = px.inspect_character(hero)
    assert found.unit == "m" and not found.saved_in_a_pose and not found.animations
    assert (found.skeleton == "vrm" and found.joints == 22) or found.joints > 22
    assert "not a garment" in found.verdict and "--character" in found.command
    leaning = px.inspect_character(posed(hero, tmp_path / "leaning.glb", 0))
    assert leaning.saved_in_a_pose and any("bind pose" in n for n in leaning.notes)


def test_garments_on_a_rig_are_not_persons(hero, tmp_path):
    assert is_character(hero)
    document = pygltflib.GLTF2().load(str(hero))
    file = GltfFile(hero)
    primitive = document.meshes[0].primitives[0]
    points = file.accessor(primitive.attributes.POSITION)
    faces = file.accessor(primitive.indices).reshape(-1, 3)
    low, high = 0.9, 1.35
    y = points[:, 1]
    kept = faces[((y > low) & (y < high))[faces].all(axis=1)].astype(np.uint32)
    blob = document.binary_blob() + kept.tobytes()
    document.bufferViews.append(
        pygltflib.BufferView(
            buffer=0, byteOffset=len(document.binary_blob()), byteLength=kept.nbytes
        )
    )
    accessor = document.accessors[primitive.indices]
    accessor.bufferView, accessor.count = len(document.bufferViews) - 1, kept.size
    # Vertices that no face uses would count for its size.
    view = document.bufferViews[document.accessors[primitive.attributes.POSITION].bufferView]
    blob = bytearray(blob)
    part = slice(view.byteOffset, view.byteOffset + view.byteLength)
    blob[part] = np.clip(points, [-9, low, -9], [9, high, 9]).astype(np.float32).tobytes()
    document.set_binary_blob(bytes(blob))
    document.buffers[0].byteLength = len(blob)
    document.save_binary(str(tmp_path / "shirt.glb"))
    assert not is_character(tmp_path / "shirt.glb")
    assert not is_character(tmp_path / "missing.glb")


@pytest.mark.nightly
def test_a_start_cuts_the_motion_of_characters(hero):
    walk = procedural_clip("walk", fps=30.0)
    whole = read_character(hero, motion=walk[:30])
    cut = px.load_character(hero, motion=walk, start=0.5, frames=6)
    # Both stand on the floor by the lowest point of their own frames.
    gap = cut.mesh.positions - whole.mesh.positions[15:21]
    assert np.ptp(gap, axis=(0, 1)).max() < 1e-4 and np.abs(gap[..., [0, 2]]).max() < 1e-4
    later = cut.after(0.1)
    np.testing.assert_array_equal(later.mesh.positions, cut.mesh.positions[3:])
    assert later.motion.num_frames == 3 and len(later.rig.world) == 3
    with pytest.raises(MotionError, match="start is 9"):
        cut.after(9.0)


def test_a_start_cuts_animated_persons(tmp_path):
    x = np.random.default_rng(0).normal(size=(1, 40, 3)).astype(np.float32)
    x = x + np.arange(12, dtype=np.float32)[:, None, None] * [0.1, 0, 0]
    x[..., 1] *= 1.7 / np.ptp(x[0, :, 1])
    x[..., 2] *= 0.1
    faces = np.arange(39).reshape(-1, 3).astype(np.int32)
    path = tmp_path / "person.npz"
    np.savez(path, positions=x.astype(np.float32), faces=faces, fps=np.array(30.0))
    whole, cut = (read_character(path, start=s).mesh.positions for s in (0.0, 0.1))
    np.testing.assert_allclose(cut, whole[3:], atol=1e-6)
    with pytest.raises(FormatError, match="start is 3"):
        read_character(path, start=3.0)


@pytest.fixture(scope="module")
def dressed(hero, tmp_path_factory):
    """A rig with an animation and an extension of its own, and its copy with a garment."""
    folder = tmp_path_factory.mktemp("dressed")
    document = pygltflib.GLTF2().load(str(hero))
    document.extensionsUsed = ["VRMC_springBone"]
    document.extensions = {"VRMC_springBone": {"specVersion": "1.0"}}
    document.materials = [pygltflib.Material(name="skin", extras={"toon": 1})]
    document.meshes[0].primitives[0].material = 0
    source = folder / "hero.vrm"
    document.save_binary(str(source))
    walk = procedural_clip("walk", fps=30.0)[:9]
    person = read_character(source, motion=walk)
    cloth = AnimatedMesh("veil", person.mesh.positions[:, :300] + 0.01, person.mesh.faces[:1])
    cloth = AnimatedMesh("veil", cloth.positions, np.arange(300).reshape(-1, 3).astype(np.int32))
    rig = person.rig
    from physxnet_jax.io import write_dressed_rig
    from physxnet_jax.motion import read_rig

    out = folder / "dressed.glb"
    nodes = read_rig(GltfFile(source)).nodes
    write_dressed_rig(out, source, rig.world, nodes, [cloth], 30.0, unit=rig.unit, name="walk")
    return source, out, person, cloth


def test_a_dressed_rig_keeps_what_the_file_had(dressed):
    source, out, _, _ = dressed
    before, after = (GltfFile(p).declared() for p in (source, out))
    assert after["extensions"] == before["extensions"]
    assert after["materials"][0] == before["materials"][0]
    assert after["skins"] == before["skins"] and after["meshes"][0] == before["meshes"][0]
    assert after["nodes"][: len(before["nodes"])] == before["nodes"]
    for k in range(len(before["accessors"])):
        np.testing.assert_array_equal(GltfFile(out).accessor(k), GltfFile(source).accessor(k))
    assert [a["name"] for a in after["animations"]] == ["walk"]


def test_a_dressed_rig_moves_as_the_character_did(dressed):
    _, out, person, cloth = dressed
    again = read_character(f"{out}#walk", fps=30.0, mesh="Figure")
    np.testing.assert_allclose(again.mesh.positions, person.mesh.positions, atol=1e-5)
    file = GltfFile(out)
    node = next(k for k, n in enumerate(file.document.nodes) if n.name == "veil")
    times = file.frame_times(0, rate=30.0)[0]
    weights = file.morph_weights(node, times, 0)
    base = file.accessor(file.document.meshes[-1].primitives[0].attributes.POSITION)
    np.testing.assert_allclose(base, cloth.positions[0], atol=1e-6)
    assert weights.shape == (9, 8) and np.allclose(weights[1:], np.eye(8), atol=1e-5)


@pytest.mark.release
def test_only_driven_rigs_are_written_and_only_as_glb(hero, tmp_path):
    person = px.load_character(hero, motion="walk", frames=2)
    with pytest.raises(FormatError, match=r"written as \.glb"):
        px.write_dressed_character(tmp_path / "a.usdc", person, ())
    import dataclasses

    with pytest.raises(FormatError, match="write_clip"):
        px.write_dressed_character(tmp_path / "a.glb", dataclasses.replace(person, rig=None), ())
    px.write_dressed_character(tmp_path / "a.glb", person, ())
    assert GltfFile(tmp_path / "a.glb").animation_names() == ["walk"]


def test_animations_are_chosen_by_option_only_in_gltf():
    from physxnet_jax.cli._options import MotionSource, with_animation
    from physxnet_jax.errors import PhysXNetError

    source = MotionSource(animation="Run")
    assert with_animation("a.glb", source) == "a.glb#Run"
    assert with_animation("walk", MotionSource()) == "walk"
    for wrong in ("walk", "a.bvh", "a.glb#Jump"):
        with pytest.raises(PhysXNetError, match="--animation"):
            with_animation(wrong, source)


def test_a_motion_is_cut_by_a_slice():
    walk = procedural_clip("walk", fps=30.0)
    np.testing.assert_array_equal(walk[3:9].root, walk.root[3:9])
    assert walk[::2].fps == 15.0 and walk[-4:].num_frames == 4
    for wrong in (slice(5, 5), slice(None, None, -1)):
        with pytest.raises(MotionError):
            walk[wrong]
    assert load_motion("walk", fps=30.0)[:1].num_frames == 1
