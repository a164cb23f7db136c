"""Fine meshes: cloth is computed at some vertices, and the others follow."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physxnet_jax.dressing import (
    clothe,
    clothe_step,
    dress,
    init_stream,
    make_dresser,
    with_cut,
    with_shape,
)
from physxnet_jax.dressing.postprocess import _sites, make_sites
from physxnet_jax.garment import load_garment, skin_garment, template
from physxnet_jax.io import write_obj
from physxnet_jax.motion import clip_transforms, load_motion


@pytest.fixture(scope="module")
def fine(tmp_path_factory):
    """Trousers of more vertices than the limit set below."""
    mesh = template("bottom").mesh
    path = tmp_path_factory.mktemp("fine") / "fine.obj"
    write_obj(path, np.asarray(mesh.vertices), np.asarray(mesh.faces))
    return path


@pytest.fixture
def few(monkeypatch):
    monkeypatch.setattr(_sites, "FINE_MESH", 2_000)
    monkeypatch.setattr(_sites, "NUM_SITES", 900)


def test_meshes_of_usual_size_have_no_sites(dresser):
    assert dresser.sites == (None,)
    assert dresser.worn[0].rest.shape == dresser.garments[0].mesh.vertices.shape
    cloth = (jnp.zeros((1, dresser.worn[0].rest.shape[0], 3)),)
    pose = jnp.zeros((1, 31, 3, 3)), jnp.zeros((1, 31, 3))
    # Nothing is added to the program.
    assert dresser.expand(cloth, *pose)[0] is cloth[0]


@pytest.mark.usefixtures("few")
def test_skinned_fine_meshes_are_skinned_exactly(fine, motion):
    dresser = make_dresser([str(fine)], method="lbs")
    sites, worn = dresser.sites[0], dresser.worn[0]
    assert sites is not None and len(worn.rest) == len(sites.rows) < 1_500
    clip = load_motion("punch", fps=30.0)
    r, t = (x[:3] for x in clip_transforms(dresser.body, dresser.rest, clip))
    for a, b in zip(r, t, strict=True):
        a, b = jnp.asarray(a), jnp.asarray(b)
        skinned = skin_garment(worn, a, b)
        whole = sites.expand(worn, skinned, a, b)
        exact = skin_garment(sites.whole, a, b)
        np.testing.assert_array_equal(np.asarray(whole), np.asarray(exact))
        # The control: sites that are moved take the others along.
        moved = sites.expand(worn, skinned + jnp.array([[0.0, 0.1, 0.0]]), a, b)
        gap = np.asarray(moved - exact) - [0.0, 0.1, 0.0]
        assert np.abs(gap).max() < 1e-5


@pytest.mark.usefixtures("few")
def test_fine_meshes_keep_the_order_of_their_vertices(fine):
    garment, _ = load_garment(fine)
    dresser = make_dresser([str(fine)], method="lbs")
    rest = np.asarray(dresser.rest)
    sites = dresser.sites[0]
    np.testing.assert_allclose(
        np.asarray(sites.whole.rest),
        np.asarray(garment.rest_vertices(jnp.asarray(rest))),
        atol=1e-6,
    )
    pinned = np.flatnonzero(np.asarray(garment.pinned))
    fixed = garment.with_pins(np.array([17, 1321]))
    chosen = set(np.asarray(make_sites(fixed, dresser.rest).rows))
    assert {17, 1321} <= chosen and len(pinned) < len(chosen)


@pytest.mark.release
@pytest.mark.usefixtures("few")
def test_network_and_guided_cloth_of_fine_meshes_is_near_that_of_all_vertices(fine, monkeypatch):
    motion = load_motion("walk", fps=30.0)
    found = {}
    for name in ("sites", "all"):
        if name == "all":
            monkeypatch.setattr(_sites, "FINE_MESH", 10**9)
        for method in ("network", "guided"):
            clip = dress(motion, [str(fine)], method=method, frames=12, include_body=False)
            found[name, method] = np.asarray(clip.garments[0].positions)
            assert clip.inside[clip.garments[0].name] < 0.05
    for method, most in (("network", 0.012), ("guided", 0.03)):
        a, b = (found[name, method] for name in ("sites", "all"))
        assert a.shape == b.shape and np.isfinite(a).all()
        gap = np.linalg.norm(a - b, axis=2)
        assert np.quantile(gap, 0.95) < most


@pytest.mark.release
@pytest.mark.usefixtures("few")
def test_fine_meshes_stream_vary_and_differentiate(fine, motion):
    rotations, root = motion
    dresser = make_dresser([str(fine)])
    name, count = dresser.worn[0].name, dresser.garments[0].num_vertices
    whole = clothe(dresser, rotations, root, 30.0)[name]
    assert whole.shape == (len(rotations), count, 3)
    stream = init_stream(dresser, rotations, root)
    step = jax.jit(clothe_step, static_argnames="fps")
    for k in range(len(rotations)):
        stream, cloth = step(dresser, stream, rotations[k], root[k], fps=30.0)
        np.testing.assert_allclose(np.asarray(cloth[name]), np.asarray(whole[k]), atol=1e-5)
    tall = dresser.body.shape(height_up=0.5)
    varied = clothe(with_shape(dresser, tall), rotations, root, 30.0)[name]
    made = clothe(make_dresser([str(fine)], shape=tall), rotations, root, 30.0)[name]
    np.testing.assert_allclose(np.asarray(varied), np.asarray(made), atol=1e-4)
    wider = dresser.sites[0].whole.rest * jnp.array([[1.1, 1.0, 1.1]])
    cut = clothe(with_cut(dresser, {name: wider}), rotations, root, 30.0)[name]
    assert float(jnp.abs(cut - whole).max()) > 0.005
    slope = jax.grad(lambda q: jnp.sum(clothe(dresser, q, root, 30.0)[name] ** 2))(rotations)
    assert np.isfinite(np.asarray(slope)).all() and np.asarray(slope).any()
