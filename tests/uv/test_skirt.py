"""The chart of skirts: continuous around the legs, seen by both, and left alone by all else."""

import jax.numpy as jnp
import numpy as np
import pytest

from physxnet_jax.body import NUM_BODY_VERTICES
from physxnet_jax.garment import tailor
from physxnet_jax.geometry import mesh_edges
from physxnet_jax.uv import bind, garment_map_rows, make_atlas
from physxnet_jax.uv._skirt import arm_weights, skirt_hull, skirt_samples


@pytest.fixture(scope="module")
def hull(body):
    return skirt_hull(body, np.asarray(body.rest_vertices(body.default_shape())))


@pytest.fixture(scope="module")
def atlas():
    return make_atlas(64, skirt=True)


@pytest.fixture(scope="module")
def aline():
    return tailor("aline")


def test_the_chart_unrolls_the_hull(hull):
    rng = np.random.default_rng(0)
    turn, drop = rng.uniform(0, 1, 200), rng.uniform(0, 1, 200)
    back = hull.angle_and_drop(hull.points(turn, drop))
    np.testing.assert_allclose(back, (turn, drop), atol=1e-9)
    front, left = hull.points(np.array([0.5, 0.75]), np.array([0.5, 0.5]))
    assert front[2] > hull.middle.max() and abs(front[0]) < 1e-9
    assert left[0] > 0.1, "the person's left is at positive x"


@pytest.mark.parametrize("shape", [{}, {"weight_up": 1.0}, {"height_down": 1.0}])
def test_the_hull_encloses_hips_and_legs_and_no_arms(body, shape):
    rest = np.asarray(body.rest_vertices(body.shape(**shape)))
    hull = skirt_hull(body, rest)
    legs = arm_weights(body, np.asarray(body.weights)[:NUM_BODY_VERTICES]) < 0.2
    v = rest[:NUM_BODY_VERTICES][legs]
    v = v[(v[:, 1] > hull.heights[0]) & (v[:, 1] < hull.top)]
    across = np.abs(v[:, 0]) / np.interp(v[:, 1], hull.heights, hull.half_width)
    assert 0.98 < across.max() < 1.15
    assert hull.half_width.max() < 0.35 and hull.half_depth.min() > 0.02


def test_an_atlas_without_it_is_the_same_as_before_and_with_it_is_longer(atlas):
    plain = make_atlas(64)
    assert (plain.height, plain.body_rows, atlas.height, atlas.body_rows) == (64, 64, 96, 64)
    count = plain.num_texels
    assert atlas.num_body_texels == count and atlas.num_texels == count + 32 * 64
    np.testing.assert_array_equal(atlas.texels[:count], plain.texels)
    assert plain.digest() != atlas.digest()
    assert plain.used == atlas.used
    values = jnp.arange(3.0 * atlas.num_texels).reshape(-1, 3)
    np.testing.assert_array_equal(atlas.from_map(atlas.to_map(values)), values)


def test_texels_see_both_legs(body, atlas):
    """Moving one leg moves its side of the chart, and half of what lies between the legs."""
    leg = np.asarray(body.weights)[:, [body.joint("LeftLeg"), body.joint("LeftFoot")]].sum(axis=1)
    moved = atlas.at_texels(jnp.asarray(leg[:, None]))[atlas.num_body_texels :, 0]
    moved = np.asarray(moved).reshape(32, 64)[-6:]
    assert moved[:, 40:56].min() > 0.9, "the left side"
    assert moved[:, 8:24].max() < 1e-6, "the right side"
    # Columns on both sides of the middle, in front and behind.
    for columns in ([31, 32], [0, -1]):
        np.testing.assert_allclose(moved[:, columns].sum(axis=1), 1.0, atol=0.05)
    assert np.abs(np.diff(moved, axis=1)).max() < 0.3, "without jumps"


def test_its_halves_are_mirror_images(body, atlas):
    rest = atlas.at_texels(body.rest_vertices(body.default_shape()))
    maps = np.asarray(atlas.to_map(rest))[64:]
    assert np.abs(maps - maps[:, ::-1] * [-1.0, 1.0, 1.0]).max() < 5e-3


def test_neighbours_on_a_dress_are_neighbours_on_the_chart(body, hull, aline):
    vertices = np.asarray(aline.mesh.vertices)
    share = hull.share(vertices[:, 1], arm_weights(body, np.asarray(aline.skin)))
    assert (share[vertices[:, 1] < 0.0] == 1.0).all() and (share[vertices[:, 1] > 0.3] == 0.0).all()
    edges = mesh_edges(np.asarray(aline.mesh.faces)).vertices
    assert np.abs(share[edges[:, 0]] - share[edges[:, 1]]).max() < 0.25, "passes over smoothly"
    turn, drop = hull.angle_and_drop(vertices)
    low = edges[(share[edges] > 0.0).all(axis=1)]
    around = np.abs(turn[low[:, 0]] - turn[low[:, 1]])
    around = np.minimum(around, 1.0 - around)
    # 5 texels of 64, and two of 32.
    assert around.max() < 5 / 64 and np.abs(drop[low[:, 0]] - drop[low[:, 1]]).max() < 2 / 32


def test_sampling_goes_round_and_avoids_what_is_not_covered(atlas, hull):
    chart = atlas.skirt
    points = hull.points(np.array([0.001, 0.999]), np.array([0.5, 0.5]))
    texel, weight, missed = skirt_samples(chart, hull, points, np.ones(32 * 64, bool))
    for k in range(2):
        assert set(texel[k] % 64) == {0, 63} and weight[k].min() > 0.0 and not missed[k]
    np.testing.assert_allclose(weight.sum(axis=1), 1.0, atol=1e-6)
    valid = np.zeros(32 * 64, bool)
    valid[10 * 64 + 63] = True
    texel, weight, missed = skirt_samples(chart, hull, points, valid)
    assert missed.all() and (texel[weight > 0.0] == 10 * 64 + 63).all()
    texel, weight, _ = skirt_samples(chart, hull, points, np.zeros(32 * 64, bool))
    assert (weight == 0.0).all(), "nothing is sampled where nothing is known"


@pytest.mark.release
def test_maps_of_a_dress_give_it_back(body, atlas, aline):
    rest = body.rest_vertices(body.default_shape())
    rows = garment_map_rows(atlas, body, rest, aline)
    assert int(rows.valid[atlas.num_body_texels :].sum()) > 500
    bound = bind(aline, atlas=atlas, valid=rows.valid)
    assert float(bound.hit_rate) > 0.99 and int(bound.off_chart) < 0.01 * aline.num_vertices
    np.testing.assert_allclose(np.asarray(bound.weight).sum(axis=1), 1.0, atol=1e-5)
    # A smooth displacement, which differs from leg to leg.
    x = np.asarray(aline.mesh.vertices)
    wanted = 0.05 * np.stack([np.sin(6 * x[:, 0]), np.cos(5 * x[:, 1]), x[:, 2]], axis=1)
    got = bound.sample(rows @ jnp.asarray(wanted.astype(np.float32)))
    low = x[:, 1] < 0.2
    assert np.abs(np.asarray(got) - wanted)[low].max() < 7e-3
    # The control: without the chart neighbours in the middle sample different legs.
    plain = make_atlas(64)
    rows = garment_map_rows(plain, body, rest, aline)
    got = bind(aline, atlas=plain, valid=rows.valid).sample(rows @ jnp.asarray(wanted, np.float32))
    assert np.abs(np.asarray(got) - wanted)[low].max() > 1.5e-2


@pytest.mark.release
@pytest.mark.parametrize("kind", ["shirt", "trousers"])
def test_other_garments_do_not_touch_it(body, atlas, kind):
    garment = tailor(kind)
    bound = bind(garment, atlas=atlas, valid=jnp.ones(atlas.num_texels, bool))
    assert bound.texel.shape[1] == 4 and int(bound.texel.max()) < atlas.num_body_texels
    rows = garment_map_rows(atlas, body, body.rest_vertices(body.default_shape()), garment)
    assert not rows.valid[atlas.num_body_texels :].any()
