"""Rows by index and the search for the nearest triangle."""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.spatial import KDTree

from physxnet_jax.body import load_body, triangulate
from physxnet_jax.geometry import closest_barycentric
from physxnet_jax.simulation.effects._gather import gather, nearest_face, pick_nearest


def distance_to(points, x, corners):
    """Distances [m] of points to one triangle each."""
    tri = [jnp.asarray(x[c].T) for c in corners.T]
    return np.sqrt(np.asarray(closest_barycentric(jnp.asarray(points.T), *tri)[1]))


def test_rows_are_those_of_each_batch_member():
    x = jnp.asarray(np.random.default_rng(0).normal(size=(7, 3, 2)), jnp.float32)
    index = jnp.asarray([[0, 6], [3, 3], [5, 1]], jnp.int32)
    found = jnp.stack(gather(x, index), axis=1)
    for lane in range(2):
        np.testing.assert_array_equal(found[:, :, lane], x[index[:, lane], :, lane])


@pytest.mark.release
@settings(deadline=None, max_examples=20)
@given(st.integers(0, 2**31 - 1))
def test_nearest_of_few_candidates_is_exact(seed):
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(12, 3)).astype(np.float32)
    points = rng.normal(size=(5, 3)).astype(np.float32)
    faces = np.stack([rng.permutation(12)[:3] for _ in range(3)]).astype(np.int32)
    patch = np.repeat(np.arange(3, dtype=np.int32)[:, None], 5, axis=1)
    near = nearest_face(
        jnp.asarray(points)[..., None],
        jnp.asarray(x)[..., None],
        jnp.asarray(faces),
        jnp.asarray(patch)[..., None],
    )[:, 0]
    best = distance_to(points, x, faces[np.asarray(near)])
    least = np.min([distance_to(points, x, np.repeat(f[None], 5, 0)) for f in faces], axis=0)
    np.testing.assert_allclose(best, least, atol=1e-3)
    picked = pick_nearest(
        jnp.asarray(points)[..., None],
        jnp.asarray(x)[..., None],
        jnp.repeat(jnp.arange(12, dtype=jnp.int32)[:, None], 5, axis=1)[..., None],
    )[:, 0]
    gap = np.linalg.norm(x[None] - points[:, None], axis=2)
    found = np.take_along_axis(gap, np.asarray(picked)[:, None], axis=1)[:, 0]
    np.testing.assert_allclose(found, gap.min(axis=1), rtol=1e-4)


@pytest.mark.release
def test_three_nearest_middles_hold_the_nearest_triangle_of_the_skin():
    """Points within 3 cm of the body: twelve candidates, of which three are compared exactly."""
    body = load_body()
    x = np.asarray(body.rest_vertices(body.default_shape()), np.float32)
    faces = np.asarray(triangulate(body.quads)).astype(np.int32)
    rng = np.random.default_rng(0)
    own = rng.integers(0, len(faces), 2000)
    points = x[faces[own]].mean(axis=1) + rng.uniform(-0.03, 0.03, (2000, 3)).astype(np.float32)
    patch = KDTree(x[faces].mean(axis=1)).query(points, k=12)[1].T.astype(np.int32)
    every = np.stack([distance_to(points, x, faces[p]) for p in patch])

    def excess(candidates):
        near = nearest_face(
            jnp.asarray(points)[..., None],
            jnp.asarray(x)[..., None],
            jnp.asarray(faces),
            jnp.asarray(candidates)[..., None],
        )[:, 0]
        return distance_to(points, x, faces[np.asarray(near)]) - every.min(axis=0)

    off = excess(patch)
    assert off.max() < 4e-3
    assert (off < 1e-5).mean() > 0.98
    # A triangle that is listed often takes the place of no other.
    often = np.concatenate([np.repeat(patch[:1], 6, axis=0), patch])
    np.testing.assert_array_equal(excess(often), off)
    # The first middle alone isn't enough.
    assert (excess(patch[:1]) < 1e-5).mean() < 0.98
