"""Garments made on another body: another shape, pose, unit, axis and place."""

import jax.numpy as jnp
import numpy as np
import pytest

from physxnet_jax.body import NUM_BODY_VERTICES, t_pose
from physxnet_jax.errors import FormatError, MeshError, PhysXNetError
from physxnet_jax.garment import load_garment, parse_wear, template, with_made_on
from physxnet_jax.garment._made_on import _carry
from physxnet_jax.io import write_obj


@pytest.fixture(scope="module")
def other(body, tmp_path_factory):
    """Writes what lies on a tall, heavy person in T-pose, in centimetres, Z up, off the origin."""
    folder = tmp_path_factory.mktemp("other")
    rest = body.rest_vertices(body.shape(height_up=0.6, weight_up=0.8))
    pose = jnp.asarray(t_pose(body), jnp.float32)
    moved = body.transforms(rest, pose, jnp.asarray(body.joint_positions(rest)[0][0]))
    turns, shifts = (np.asarray(x) for x in moved)

    def write(name, points, weights, faces):
        x = np.einsum("vj,jab,vb->va", weights, turns, points) + weights @ shifts
        x = 100 * (x + [0.3, 1.2, 0.1])[:, [0, 2, 1]] * [1, -1, 1]
        write_obj(folder / name, x, np.asarray(faces))
        return folder / name

    skin = np.asarray(body.weights)[:NUM_BODY_VERTICES]
    faces = body.rest_mesh().faces
    write("avatar.obj", np.asarray(rest)[:NUM_BODY_VERTICES], skin, faces)
    for kind in ("top", "dress"):
        g = template(kind)
        worn = np.asarray(g.rest_vertices(rest))
        write(f"{kind}.obj", worn, np.asarray(g.skin), g.mesh.faces)
    return folder


@pytest.mark.nightly
@pytest.mark.parametrize("kind", ["top", "dress"])
def test_garments_come_back_from_the_body_that_they_were_made_on(other, kind):
    garment, report = load_garment(f"{other / kind}.obj:made_on={other / 'avatar.obj'}")
    gap = garment.mesh.vertices - template(kind).mesh.vertices
    gap = np.linalg.norm(np.asarray(gap), axis=1)
    assert np.median(gap) < 0.006 and np.quantile(gap, 0.95) < 0.02
    assert report.template == kind and report.inside < 0.02
    assert "made on avatar.obj" in report.placed[0]


@pytest.mark.release
def test_garments_far_from_their_body_are_refused(other, tmp_path):
    g = template("top")
    far = 100 * (np.asarray(g.mesh.vertices)[:, [0, 2, 1]] * [1, -1, 1] + 5.0)
    write_obj(tmp_path / "far.obj", far, np.asarray(g.mesh.faces))
    with pytest.raises(MeshError, match="from one scene"):
        load_garment(f"{tmp_path / 'far.obj'}:made_on={other / 'avatar.obj'}")


def test_skin_carries_points_rigidly(body, rest):
    """Points beside a body that is turned and moved as a whole are turned and moved with it."""
    skin = np.asarray(rest, np.float64)[:NUM_BODY_VERTICES]
    points = skin[::97] + np.random.default_rng(0).normal(0.0, 0.05, skin[::97].shape)
    turn = np.array([[0, 0, 1.0], [0, 1, 0], [-1, 0, 0]])
    moved = _carry(points, skin, skin @ turn.T + [1.0, 2.0, 3.0])
    np.testing.assert_allclose(moved, points @ turn.T + [1.0, 2.0, 3.0], atol=1e-9)
    np.testing.assert_allclose(_carry(points, skin, skin), points, atol=1e-9)


def test_bodies_that_are_none_are_refused(tmp_path):
    g = template("top")
    small = tmp_path / "small.obj"
    write_obj(small, 1e-5 * np.asarray(g.mesh.vertices), np.asarray(g.mesh.faces))
    write_obj(tmp_path / "top.obj", np.asarray(g.mesh.vertices), np.asarray(g.mesh.faces))
    with pytest.raises(MeshError, match="no person's"):
        load_garment(f"{tmp_path / 'top.obj'}:made_on={small}")
    with pytest.raises(FormatError, match="no such file"):
        load_garment(f"{tmp_path / 'top.obj'}:made_on=missing.obj")
    with pytest.raises(PhysXNetError, match="leave unit, up and front out"):
        load_garment(f"{tmp_path / 'top.obj'}:made_on={small},unit=m")


def test_the_body_is_named_for_files_alone():
    words = with_made_on(["shirt", "top", "coat.obj:as=top", "hat.glb"], "avatar.obj")
    assert words[:2] == ("shirt", "top")
    assert [parse_wear(w).made_on for w in words[2:]] == ["avatar.obj"] * 2
    assert with_made_on(words, "other.obj") == words
    assert parse_wear(parse_wear(words[2]).word("coat.obj")).made_on == "avatar.obj"
