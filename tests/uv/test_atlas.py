"""The atlas, rasterisation and sampling."""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from physxnet_jax.body import NUM_BODY_VERTICES
from physxnet_jax.uv import (
    Transference,
    acceleration_maps,
    body_map,
    dress_body,
    make_atlas,
    rasterise,
    velocity_maps,
)


@pytest.mark.parametrize("size", [64, 128, (96, 160)])
def test_atlas_fills_the_unit_square_without_flipped_faces(size):
    atlas = make_atlas(size)
    assert atlas.used > 0.7 and atlas.used_before < 0.4
    texels = np.asarray(atlas.texels)
    assert (np.diff(texels) > 0).all()
    uv = np.asarray(atlas.uv)[np.asarray(atlas.uv_faces)]
    u, v = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    assert (u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0] > 0).all(), "a face is flipped"
    assert uv.min() >= 0 and uv.max() <= 1


def test_atlas_excludes_face_hands_and_feet(body):
    atlas = make_atlas(64)
    used = np.unique(np.asarray(atlas.faces))
    points = np.asarray(body.rest_mesh().vertices)[used]
    weights = np.asarray(body.weights)[used]
    head = weights[:, body.joint("Head")]
    foot = weights[:, [body.joint("LeftToeBase"), body.joint("RightToeBase")]].sum(axis=1)
    assert head.max() < 0.7 and foot.max() < 0.7
    assert points[:, 1].max() < 0.6


def test_texel_points_lie_on_the_body_with_row_stochastic_weights(body):
    atlas = make_atlas(64)
    weights = np.asarray(atlas.to_body.weights)
    assert weights.min() >= 0
    np.testing.assert_allclose(weights.sum(axis=1), 1, atol=1e-6)
    points = np.asarray(atlas.to_body @ body.rest_mesh().vertices)
    assert np.isfinite(points).all()
    # A texel's uv is its centre.
    face = {tuple(f): k for k, f in enumerate(np.asarray(atlas.faces).tolist())}
    rows = [face[tuple(t)] for t in np.asarray(atlas.to_body.vertices).tolist()]
    uv = np.asarray(atlas.uv)[np.asarray(atlas.uv_faces)[rows]]
    at = np.einsum("pk,pkc->pc", weights, uv)
    texels = np.asarray(atlas.texels)
    centre = np.column_stack([(texels % 64 + 0.5) / 64, 1 - (texels // 64 + 0.5) / 64])
    np.testing.assert_allclose(at, centre, atol=1e-5)


def test_maps_round_trip():
    atlas = make_atlas(32)
    values = jnp.asarray(
        np.random.default_rng(0).normal(size=(2, atlas.num_texels, 3)), jnp.float32
    )
    maps = atlas.to_map(values)
    assert maps.shape == (2, 32, 32, 3)
    np.testing.assert_array_equal(np.asarray(atlas.from_map(maps)), np.asarray(values))
    assert float(jnp.abs(jnp.where(atlas.mask[None, :, :, None], 0.0, maps)).max()) == 0.0


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000), st.integers(8, 40))
def test_every_texel_of_a_triangulated_square_is_covered_once(seed, size):
    """A fan around a random inner point covers the unit square: no hole, no texel twice."""
    rng = np.random.default_rng(seed)
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0, 0]], float)
    uv[4] = rng.uniform(0.1, 0.9, 2)
    if seed % 3 == 0:
        uv[4] = 0.5  # texel centres and diagonals coincide
    faces = np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
    texels, own, weights = rasterise(uv, faces, size, size)
    assert len(texels) == size * size == len(np.unique(texels))
    at = np.einsum("pk,pkc->pc", weights, uv[faces[own]])
    centre = np.column_stack([(texels % size + 0.5), size - (texels // size + 0.5)]) / size
    np.testing.assert_allclose(at, centre, atol=1e-4)


def test_degenerate_triangles_cover_no_texels():
    uv = np.array([[0, 0], [1, 1], [0.5, 0.5], [0, 1]])
    texels, _, weights = rasterise(uv, np.array([[0, 1, 2], [0, 0, 0]]), 16, 16)
    assert len(texels) == 0 and np.isfinite(weights).all()
    assert len(rasterise(uv, np.array([[0, 1, 3], [0, 1, 2]]), 16, 16)[0]) > 100


def test_velocity_and_acceleration_maps_of_a_parabola_are_exact():
    t = np.arange(8) / 30.0
    path = jnp.asarray((0.5 * 3.0 * t**2)[:, None, None] * np.ones((1, 2, 3)), jnp.float32)
    velocity, acceleration = velocity_maps(path, 30.0), acceleration_maps(path, 30.0)
    assert float(jnp.abs(velocity[0]).max()) == 0.0
    np.testing.assert_allclose(np.asarray(acceleration[2:]), 3.0, rtol=1e-3)
    expected = 3.0 * (t[1:] - 0.5 / 30.0)
    np.testing.assert_allclose(np.asarray(velocity[1:, 0, 0]), expected, rtol=1e-3)


def test_transference_preserves_constants_and_batches():
    t = Transference(
        jnp.array([[0, 1, 2], [2, 2, 2]]),
        jnp.array([[0.2, 0.3, 0.5], [1, 0, 0.0]]),
        jnp.ones(2, bool),
        3,
    )
    ones = jnp.ones((4, 3, 2))
    np.testing.assert_allclose(np.asarray(body_map(t, jnp.ones((4, 3, 3)))), 1.0, atol=1e-6)
    assert (t @ ones).shape == (4, 2, 2)


def test_dress_body_joins_the_legs_and_changes_nothing_else(body, rest):
    joined = dress_body(body, np.asarray(rest))
    plain = np.asarray(rest[:NUM_BODY_VERTICES])
    assert joined.shape == plain.shape and np.isfinite(joined).all()
    high = plain[:, 1] > 0.05
    np.testing.assert_allclose(joined[high], plain[high], atol=1e-6)
    knee = np.abs(plain[:, 1] + 0.35) < 0.02
    front = joined[knee & (joined[:, 2] > 0.07)]
    gap = np.abs(front[:, 0]).min()
    assert gap < 0.03 < np.abs(plain[knee][:, 0]).min() + 0.03


def test_inner_leg_halves_lie_beneath_the_hull(body, rest):
    """A ray from outside meets the outer half first: the inner one is a tenth deeper."""
    joined = dress_body(body, np.asarray(rest))
    ring = joined[np.abs(np.asarray(rest)[: len(joined), 1] + 0.35) < 0.03]
    low, high = ring.min(axis=0), ring.max(axis=0)
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    r = np.hypot(*((ring - middle) / half)[:, [0, 2]].T)
    assert r.max() < 1.1 and (r < 0.9).mean() > 0.2
