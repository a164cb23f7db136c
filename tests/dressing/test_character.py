"""People of one's own, dressed: against the same clothes on the person they were made from."""

import dataclasses
import pathlib
import runpy

import fast_simplification
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import KDTree

from physxnet_jax.body import Registration, linear_blend_skinning, t_pose
from physxnet_jax.cli import main
from physxnet_jax.dressing import Inference, Simulation, dress, make_character
from physxnet_jax.dressing._character import (
    _corners,
    _near,
    _poses as character_poses,
    bind_to_character,
    character_penetration,
    resolve_character_collisions,
)
from physxnet_jax.dressing.postprocess import _sites
from physxnet_jax.dressing.postprocess._collisions import faces_at_rest, make_collider
from physxnet_jax.dressing.postprocess._layers import layer_height
from physxnet_jax.errors import PhysXNetError
from physxnet_jax.garment import make_skinned, template
from physxnet_jax.geometry import closest_points, make_mesh, vertex_normals
from physxnet_jax.io import AnimatedMesh, smooth_normals
from physxnet_jax.motion import Motion, body_animation, clip_transforms, load_motion

_SAMPLES = runpy.run_path(str(pathlib.Path(__file__).parents[1] / "samples.py"))
rigged_person = _SAMPLES["rigged_person"]

FPS = 10.0


def rmse(a, b):
    return float(np.sqrt(((a - b) ** 2).sum(axis=-1).mean()))


@pytest.fixture(scope="module")
def man(body):
    """A tall man who punches, in the triangles of a stranger; his bind pose is a T."""
    shape = body.shape(gender=1.0, height_up=0.7, muscle_up=0.5)
    clip = load_motion("punch", fps=FPS, shape=shape)
    clip = Motion(clip.rotations[:8], clip.root[:8], FPS, "punch")
    rest = body.rest_vertices(shape)
    world, shift = body.transforms(rest, t_pose(body, shape), jnp.asarray([0.0, 1.0, 0.0]))
    n = 13380
    bind = np.asarray(linear_blend_skinning(rest[:n], body.weights[:n], world, shift))
    faces = np.asarray(body.rest_mesh().faces)
    vertices, other = fast_simplification.simplify(
        np.array(bind), np.array(faces), target_count=12000
    )
    foot = closest_points(make_mesh(bind, faces), jnp.asarray(vertices, jnp.float32))
    x = np.asarray(body_animation(body, clip, shape))[:, faces[np.asarray(foot.face)]]
    x = np.einsum("vk,fvkc->fvc", np.asarray(foot.weights), x)
    mesh = AnimatedMesh("me", x.astype(np.float32), other.astype(np.int32))
    return shape, clip, mesh, vertices.astype(np.float32)


@pytest.fixture(scope="module")
def character(man):
    _, _, mesh, bind = man
    return make_character(mesh, FPS, bind=bind)


@pytest.mark.nightly
def test_garments_on_a_registered_character_match_its_true_shape(man, character):
    shape, clip, mesh, _ = man
    assert character.apart < 0.008 and character.missed < 0.01
    worn = dress(character, ["top", "bottom"], method="lbs")
    true = dress(clip, ["top", "bottom"], method="lbs", shape=shape, fps=FPS)
    other = dress(clip, ["top", "bottom"], method="lbs", fps=FPS)
    np.testing.assert_array_equal(worn.meshes[0].positions, mesh.positions)
    np.testing.assert_array_equal(worn.meshes[0].faces, mesh.faces)
    assert worn.fps == FPS and "mm from the mesh" in worn.notes[0]
    for a, b, wrong in zip(worn.garments, true.garments, other.garments, strict=True):
        assert a.name == b.name and rmse(a.positions, b.positions) < 0.02
        # The control: on another person's shape they are elsewhere.
        assert rmse(wrong.positions, b.positions) > 0.04
    assert worn.inside["bottom"] < 0.01 and worn.inside["top"] < 0.04
    assert all(worn.inside[n] <= worn.inside_raw[n] for n in worn.inside)


@pytest.mark.nightly
def test_inner_garments_stay_beneath_outer_ones_on_a_character(character, monkeypatch):
    known = []

    def keep(layers, positions):
        known[:] = layers
        return positions

    monkeypatch.setattr("physxnet_jax.dressing._character.resolve_clip_layers", keep)
    crossing = dress(character, ["dress", "top"], method="lbs", frames=2)
    monkeypatch.undo()
    apart = dress(character, ["dress", "top"], method="lbs", frames=2)
    layer, press = known
    assert (press.still, press.moved) == (layer.moved, layer.still)

    def beneath(clip):
        worn = [jnp.asarray(g.positions) for g in clip.garments]
        height = jax.vmap(lambda a, b: layer_height(layer, a, b)[0])
        return float((height(worn[layer.still], worn[layer.moved]) < 0.0).mean())

    assert beneath(apart) < 0.6 * beneath(crossing) and beneath(apart) < 0.02
    # What is beneath gives way where it came through, by little.
    pressed = np.linalg.norm(crossing.garments[0].positions - apart.garments[0].positions, axis=-1)
    assert 0.0 < (pressed > 0.0).mean() < 0.5 and np.quantile(pressed, 0.99) < 0.01
    assert apart.inside["top"] < 0.04


@pytest.mark.nightly
def test_network_and_simulation_dress_a_character(man, character):
    shape, clip, _, _ = man
    worn = dress(
        character,
        ["bottom"],
        method="network",
        inference=Inference(weights="nano", strain_iterations=0),
        include_body=False,
    )
    true = dress(
        clip,
        ["bottom"],
        method="network",
        inference=Inference(weights="nano", strain_iterations=0),
        shape=shape,
        fps=FPS,
    )
    assert rmse(worn.garments[0].positions, true.garments[0].positions) < 0.025
    assert [m.name for m in worn.meshes] == ["bottom"]
    nano = Inference(weights="nano")
    for ways in (
        {"method": "simulate", "simulation": Simulation(accuracy="draft"), "frames": 3},
        {"method": "guided", "inference": nano, "frames": 3},
    ):
        slow = dress(character, ["bottom"], **ways)
        assert slow.num_frames == 3 and len(slow.meshes[0].positions) == 3
        same = dress(clip, ["bottom"], shape=shape, fps=FPS, **ways)
        assert rmse(slow.garments[0].positions, same.garments[0].positions) < 0.025


@pytest.mark.nightly
def test_cloth_follows_residual_skin_motion(character):
    """A belly that swells by 3 cm takes the shirt with it; without that it doesn't."""
    rest = np.asarray(character.body.rest_vertices(character.body.default_shape()))[:13380]
    belly = np.exp(
        -0.5 * (np.linalg.norm(rest - (0.0, rest[:, 1].mean(), 0.12), axis=1) / 0.1) ** 2
    )
    swell = np.zeros_like(character.residual)
    swell[-1] = 0.03 * belly[:, None] * [0.0, 0.0, 1.0]
    plain = {"method": "lbs", "inference": Inference(collisions=False)}
    flat = dress(character, ["top"], **plain).garments[0].positions
    grown = dataclasses.replace(character, residual=character.residual + swell)
    out = dress(grown, ["top"], **plain).garments[0].positions - flat
    np.testing.assert_allclose(out[:-1], 0.0, atol=1e-6)
    assert 0.015 < out[-1, :, 2].max() <= 0.0301
    assert np.abs(out[-1, :, :2]).max() < 1e-6


@pytest.mark.release
def test_cloth_is_moved_out_of_the_character_surface(character):
    """Thighs that swell by 2 cm while no cloth goes along."""
    body, clip = character.body, character.motion
    rest = body.rest_vertices(body.default_shape())
    skin = np.asarray(rest)[:13380]
    thigh = np.abs(skin[:, 1] - (skin[:, 1].min() + 0.65)) < 0.1
    outward = np.asarray(vertex_normals(jnp.asarray(skin), body.rest_mesh().faces))
    world, shift = clip_transforms(body, rest, clip)
    weights = np.asarray(body.weights)[:13380]
    swollen = 0.02 * np.einsum("vj,fjab,vb->fva", weights, world, outward) * thigh[:, None]
    swollen = swollen.astype(np.float32)
    surface = np.asarray(body_animation(body, clip)) + swollen
    fat = dataclasses.replace(character, residual=swollen, surface=surface)
    g = bind_to_character(template("bottom"), character)
    w = make_skinned(g, rest)
    patch = make_collider(body, rest, w, g.mesh)
    tight = (
        dress(character, ["bottom"], method="lbs", inference=Inference(collisions=False))
        .garments[0]
        .positions
    )
    before = character_penetration(fat, tight)
    out = resolve_character_collisions(patch, w, fat, tight, world, shift)
    assert before > 0.05 and character_penetration(fat, out) < 0.2 * before
    assert np.linalg.norm(out - tight, axis=2).max() < 0.06


@pytest.mark.release
def test_guided_cloth_is_moved_out_of_the_character_surface(character):
    """Waves on the thighs, which the simulation of the skinned body doesn't see."""
    body, clip = character.body, character.motion
    rest = body.rest_vertices(body.default_shape())
    skin = np.asarray(rest)[:13380]
    high = skin[:, 1] - skin[:, 1].min()
    # Slopes of 45 degrees: steeper ones fold the skin's triangles over.
    ring = np.sin(2 * np.pi * high / 0.12) * (np.abs(high - 0.65) < 0.12)
    outward = np.asarray(vertex_normals(jnp.asarray(skin), body.rest_mesh().faces))
    world, _ = clip_transforms(body, rest, clip)
    weights = np.asarray(body.weights)[:13380]
    grown = 0.02 * np.einsum("vj,fjab,vb->fva", weights, world, outward) * ring[:, None]
    grown = grown.astype(np.float32)
    ringed = dataclasses.replace(
        character, residual=grown, surface=np.asarray(body_animation(body, clip)) + grown
    )
    found = {}
    for collisions in (True, False):
        found[collisions] = dress(
            ringed, ["bottom"], inference=Inference(weights="nano", collisions=collisions), frames=3
        )
    assert found[True].method == "guided" and found[False].inside["bottom"] > 0.01
    assert found[False].inside == found[False].inside_raw
    assert found[True].inside["bottom"] < 0.5 * found[True].inside_raw["bottom"]


@pytest.mark.release
@pytest.mark.parametrize("method", ["lbs", "network", "guided"])
def test_fine_garments_on_a_character_are_near_those_of_all_vertices(
    character, method, monkeypatch
):
    found = {}
    for limit in (2_000, 10**9):
        monkeypatch.setattr(_sites, "FINE_MESH", limit)
        monkeypatch.setattr(_sites, "NUM_SITES", 900)
        clip = dress(
            character, ["bottom"], method=method, inference=Inference(weights="nano"), frames=4
        )
        found[limit] = np.asarray(clip.garments[0].positions)
        assert clip.inside["bottom"] < 0.02
    a, b = found.values()
    assert a.shape == b.shape and np.isfinite(a).all() and not np.array_equal(a, b)
    gap = np.linalg.norm(a - b, axis=2)
    assert np.quantile(gap, 0.95) < {"lbs": 0.010, "network": 0.012, "guided": 0.03}[method]


@pytest.mark.release
def test_near_skin_follows_sliding_cloth_but_not_to_another_limb(character):
    body = character.body
    rest = body.rest_vertices(body.default_shape())
    g = bind_to_character(template("bottom"), character)
    # Cloth over a hollow has its distance in the offset, which other shapes start from.
    np.testing.assert_allclose(g.rest_vertices(rest), g.mesh.vertices, atol=1e-6)
    w = make_skinned(g, rest)
    patch = make_collider(body, rest, w, g.mesh)
    still, skin, usual = (np.asarray(x) for x in (w.rest, patch.rest, faces_at_rest(patch)))
    middle = skin[np.asarray(patch.faces)].mean(axis=1)

    def reach(points, rows):
        return np.linalg.norm(middle[rows] - points[:, None], axis=2).min(axis=1)

    thigh = np.abs(still[:, 1] - (still[:, 1].min() + 0.5)) < 0.05
    slid = still - np.array([0.0, 0.08, 0.0], np.float32)
    near = _near(patch, still, skin, slid)
    assert (reach(slid, near) <= reach(slid, usual) + 1e-6).all()
    at_rest = KDTree(middle).query(still, k=usual.shape[1])[1]
    found, control = reach(slid, near)[thigh], reach(slid, at_rest)[thigh]
    assert np.median(found) < 0.5 * np.median(control)
    # Each shin's cloth at the other shin, where all skin nearby is the other's.
    crossed = still * np.array([-1.0, 1.0, 1.0], np.float32)
    shin = still[:, 1] < still[:, 1].min() + 0.2
    np.testing.assert_array_equal(_near(patch, still, skin, crossed)[shin], usual[shin])


@pytest.mark.nightly
def test_skin_registered_to_another_limb_is_ignored(man, monkeypatch):
    """One vertex goes its own way, as a thigh's does that was laid onto a hand."""
    _, _, mesh, bind = man
    carried = Registration.carried
    found = make_character(mesh, FPS, bind=bind)
    hips = found.body.joint("Hips")
    lost = int(np.argmax(np.asarray(found.body.weights)[:13380, hips]))

    def astray(self, positions, faces):
        out = carried(self, positions, faces)
        out[4:, lost] += np.float32(0.5)
        return out

    monkeypatch.setattr(Registration, "carried", astray)
    other = make_character(mesh, FPS, bind=bind)
    assert np.abs(found.residual[:, lost]).max() > 0
    assert np.abs(other.residual[:, lost]).max() == 0
    rows = np.arange(13380) != lost
    np.testing.assert_allclose(other.residual[:, rows], found.residual[:, rows], atol=2e-3)


@pytest.mark.release
def test_coarse_mesh_corners_above_the_skin_are_measured(character):
    skin = character.surface[:1]
    normals = smooth_normals(skin, np.asarray(character.body.rest_mesh().faces))
    # Where the next vertex is far enough for the nearest one to be the one beneath.
    rows = np.argsort(-KDTree(skin[0]).query(skin[0], k=2)[0][:, 1])[:3]
    points = skin[:, rows] + 0.006 * normals[:, rows]
    rise = _corners(character.body, points, skin)
    np.testing.assert_allclose(rise[rows], 0.006, atol=1e-4)
    assert np.count_nonzero(rise) == 3
    assert _corners(character.body, skin[:, rows] - 0.006 * normals[:, rows], skin).max() == 0.0


@pytest.mark.release
def test_body_and_shape_are_refused_with_a_character(body, character):
    with pytest.raises(PhysXNetError, match="leave out body and shape"):
        dress(character, ["top"], shape=body.default_shape())
    with pytest.raises(PhysXNetError, match="leave out body and shape"):
        dress(character, ["top"], body=body)


def test_registration_poses_are_tried_by_likelihood(man):
    """The bind pose, frame 0, then the frame that takes most room; no frame twice."""
    _, _, mesh, bind = man
    wide = mesh.positions.copy()
    wide[5] *= np.float32([2.0, 1.0, 1.0])
    for given, expected in ((bind, [bind, wide[0], wide[5]]), (None, [wide[0], wide[5]])):
        found = character_poses(wide, given)
        assert len(found) == len(expected)
        assert all(a is b or np.array_equal(a, b) for a, b in zip(found, expected))
    assert len(character_poses(mesh.positions[:1], None)) == 1


@pytest.mark.release
def test_dress_command_dresses_an_animated_body_file(man, tmp_path, capsys):
    _, _, mesh, bind = man
    x = np.concatenate([bind[None], mesh.positions[:3]])[..., [0, 2, 1]] * [100.0, -100.0, 100.0]
    np.savez(tmp_path / "me.npz", me_positions=x, me_faces=mesh.faces, fps=FPS)
    out = tmp_path / "out.npz"
    words = [
        "dress",
        str(tmp_path / "me.npz"),
        "--animated-body",
        "--wear",
        "bottom",
        "--fps",
        "10",
    ]
    assert main([*words, "--method", "lbs", "-o", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "the unit is cm" in printed and "Z is up" in printed
    with np.load(out) as data:
        np.testing.assert_allclose(data["body_positions"][1:], mesh.positions[:3], atol=1e-4)
        low = data["bottom_positions"][..., 1].min() - data["body_positions"][..., 1].min()
        assert data["bottom_positions"].shape == (4, template("bottom").num_vertices, 3)
        assert 0.0 < low < 0.2
    assert main([*words, "--shape", "gender=1"]) == 2
    assert main(["dress", "walk", "--body-mesh", "me"]) == 2
    assert main(["dress", "walk", "--animated-body"]) == 2


@pytest.mark.nightly
def test_dress_command_retargets_a_motion_to_a_rig(body, tmp_path, capsys):
    shape = body.shape(gender=1.0, height_up=0.5)
    path = rigged_person(tmp_path / "me.vrm", body, shape)
    out = tmp_path / "out.npz"
    words = ["dress", "punch", "--character", str(path), "--wear", "bottom", "--fps", "10"]
    assert main([*words, "--frames", "3", "--method", "lbs", "-o", str(out)]) == 0
    true = dress("punch", ["bottom"], shape=shape, method="lbs", fps=10.0, frames=3)
    with np.load(out) as data:
        worn = data["bottom_positions"]
        # He steps as far as his legs allow, which are longer than the clip's.
        assert worn.shape == true.garments[0].positions.shape
        shift = (worn - true.garments[0].positions).mean(axis=(0, 1))
        assert np.abs(shift).max() < 0.03
        assert rmse(worn - shift, true.garments[0].positions) < 0.02
    glb = ["--frames", "3", "--method", "lbs", "-o", str(tmp_path / "worn.glb")]
    assert main([*words, *glb]) == 0
    assert "morph targets" not in capsys.readouterr().out, "the file has none"
    assert main([*words, "--animated-body"]) == 2 and "--animated-body" in capsys.readouterr().err
    assert main(["dress", "walk", "--character-map", "a.toml"]) == 2
    assert "--character" in capsys.readouterr().err
    names = tmp_path / "names.toml"
    names.write_text('Hips = "nowhere"\n')
    assert main([*words, "--character-map", str(names)]) == 2
    assert "no joint 'nowhere'" in capsys.readouterr().err


@pytest.mark.nightly
def test_ten_kilometres_away_a_character_wears_the_same(man):
    _, _, mesh, bind = man
    away = np.asarray([10_000.0, 0.0, -8_000.0], np.float32)
    there = dataclasses.replace(mesh, positions=mesh.positions[:4] + away)
    # The same rounded motion at the origin.
    here = dataclasses.replace(mesh, positions=there.positions - away)
    far, near = (make_character(m, FPS, bind=bind) for m in (there, here))
    assert not near.place.any() and np.linalg.norm(far.place - away) < 2.0
    spacing = np.spacing(np.float32(10_000.0))
    for method in ("lbs", "network"):
        a, b = (dress(p, ["bottom"], method=method) for p in (far, near))
        np.testing.assert_array_equal(a.meshes[0].positions, there.positions)
        gap = a.garments[0].positions.astype(np.float64) - away - b.garments[0].positions
        assert np.abs(gap).max() < 0.6 * spacing, (method, np.abs(gap).max())
        assert a.inside["bottom"] == pytest.approx(b.inside["bottom"], abs=0.01)
