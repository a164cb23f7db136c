"""Closest points: against a dense search, at singular points, and signed."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings, strategies as st

from physxnet_jax.geometry import (
    closest_among,
    closest_barycentric,
    closest_on_host,
    closest_points,
    fast_argmin,
    make_mesh,
    nearby_faces,
    nearest_distinct,
    nearest_index,
    nearest_indices,
    signed_distance,
)

_COORDINATE = st.floats(-2, 2, width=32)
_POINT = st.tuples(_COORDINATE, _COORDINATE, _COORDINATE)


@settings(max_examples=60, deadline=None)
@given(p=_POINT, a=_POINT, b=_POINT, c=_POINT)
def test_closest_point_is_no_farther_than_any_sampled_point(p, a, b, c):
    p, a, b, c = (np.asarray(x, np.float32) for x in (p, a, b, c))
    weights, squared = closest_barycentric(*(jnp.asarray(x)[:, None] for x in (p, a, b, c)))
    w = np.asarray(weights)[:, 0]
    assert np.isfinite(w).all() and w.min() >= -1e-5 and w.sum() == pytest.approx(1, abs=1e-4)
    u, v = np.meshgrid(np.linspace(0, 1, 21), np.linspace(0, 1, 21))
    keep = u + v <= 1
    grid = a + u[keep][:, None] * (b - a) + v[keep][:, None] * (c - a)
    best = np.sum((grid - p) ** 2, axis=1).min()
    assert float(squared[0]) <= best + 1e-3


@pytest.mark.parametrize(
    "corners",
    [
        [[0, 0, 0], [0, 0, 0], [0, 0, 0]],
        [[0, 0, 0], [1, 0, 0], [2, 0, 0]],
        [[0, 0, 0], [1, 0, 0], [1, 1e-6, 0]],
    ],
)
def test_degenerate_triangles_have_finite_value_and_gradient(corners):
    a, b, c = (jnp.asarray(x, jnp.float32)[:, None] for x in corners)

    def distance(p):
        return closest_barycentric(p[:, None], a, b, c)[1][0]

    value, slope = jax.value_and_grad(distance)(jnp.array([0.3, 0.4, 0.5]))
    assert bool(jnp.isfinite(value)) and bool(jnp.isfinite(slope).all())
    nearest = {0: 0.5, 1: 0.41, 2: 0.41}
    expected = nearest[0] if corners[1] == [0, 0, 0] else 0.41
    assert float(value) == pytest.approx(expected, abs=1e-4)


@pytest.mark.release
@pytest.mark.parametrize("size", [1.0, 1e-3, 1e-5, 1e-8, 1e-12, 0.0])
def test_gradients_by_corners_are_finite_for_tiny_triangles(size):
    corners = jnp.asarray([[0, 0, 0], [size, 0, 0], [0, size, 0]], jnp.float32)

    def distance(corners, p):
        a, b, c = (x[:, None] for x in corners)
        return closest_barycentric(p[:, None], a, b, c)[1][0]

    for p in ([1.0, 0, 0], [1, 1, 1], [0.25 * size, 0.25 * size, 0.5], [-1, 0.3, 0]):
        value, slope = jax.value_and_grad(distance)(corners, jnp.asarray(p, jnp.float32))
        assert bool(jnp.isfinite(value)) and bool(jnp.isfinite(slope).all())
        nearest = float(jnp.sum(jnp.asarray(p) ** 2)) ** 0.5
        assert abs(float(value) ** 0.5 - nearest) <= 1.01 * size + 1e-6


def test_signed_distance_of_a_sphere_is_accurate():
    s = trimesh.creation.icosphere(subdivisions=4)
    mesh = make_mesh(s.vertices, s.faces)
    points = np.random.default_rng(0).uniform(-1.5, 1.5, (400, 3)).astype(np.float32)
    expected = np.linalg.norm(points, axis=1) - 1
    ours = np.asarray(signed_distance(mesh, jnp.asarray(points)))
    np.testing.assert_allclose(ours, expected, atol=3e-3)


def test_signs_are_correct_near_edges_and_corners_of_a_box():
    box = trimesh.creation.box((1, 1, 1))
    mesh = make_mesh(box.vertices, box.faces)
    points = np.random.default_rng(1).uniform(-1, 1, (500, 3)).astype(np.float32)
    inside = (np.abs(points) < 0.5).all(axis=1)
    ours = np.asarray(signed_distance(mesh, jnp.asarray(points)))
    assert ((ours < 0) == inside).all()


@pytest.mark.release
def test_candidate_search_matches_brute_force(body):
    mesh = body.rest_mesh()
    rng = np.random.default_rng(2)
    v = np.asarray(mesh.vertices)
    points = v[rng.choice(len(v), 300, replace=False)] + rng.normal(0, 0.01, (300, 3))
    points = points.astype(np.float32)
    exact = closest_points(mesh, jnp.asarray(points))
    near = nearby_faces(v, np.asarray(mesh.faces), points, neighbours=8)
    quick = closest_among(mesh, jnp.asarray(points), jnp.asarray(near))
    miss = np.sqrt(np.asarray(quick.squared_distance)) - np.sqrt(np.asarray(exact.squared_distance))
    assert (miss > -1e-5).all()
    assert (miss > 1e-5).mean() < 0.01 and miss.max() < 2e-3
    # By NumPy, in chunks; ties are at most a rounding apart.
    face, weights, squared = closest_on_host(v, np.asarray(mesh.faces), points, near)
    np.testing.assert_allclose(np.sqrt(squared), np.sqrt(quick.squared_distance), atol=1e-6)
    foot = np.einsum("pk,pkc->pc", weights, v[np.asarray(mesh.faces)[face]])
    np.testing.assert_allclose(np.sum((points - foot) ** 2, axis=1), squared, atol=1e-7)
    assert len(closest_on_host(v, np.asarray(mesh.faces), points[:0], near[:0])[0]) == 0
    # Compared exactly only where the middles are nearest: nearly always the same point.
    few = closest_among(mesh, jnp.asarray(points), jnp.asarray(near), exactly=3)
    more = np.sqrt(np.asarray(few.squared_distance)) - np.sqrt(np.asarray(quick.squared_distance))
    assert (more > -1e-6).all() and (more > 1e-4).mean() < 0.02 and more.max() < 3e-3
    assert (np.asarray(few.face)[:, None] == near).any(axis=1).all()
    # The control: the nearest middle alone.
    one = closest_among(mesh, jnp.asarray(points), jnp.asarray(near), exactly=1)
    worse = np.sqrt(np.asarray(one.squared_distance)) - np.sqrt(np.asarray(quick.squared_distance))
    assert (worse > 1e-4).mean() > 0.05


def test_fast_argmin_matches_argmin():
    rng = np.random.default_rng(3)
    values = rng.integers(0, 5, (200, 7)).astype(np.float32)
    values[0] = np.inf
    np.testing.assert_array_equal(np.asarray(fast_argmin(jnp.asarray(values))), values.argmin(1))
    assert int(fast_argmin(jnp.full((1, 7), jnp.nan))[0]) == 6


@pytest.mark.parametrize("rows", [1, 2, 16, 97, 880])
def test_nearest_index_finds_the_smallest_value_up_to_its_precision(rows):
    rng = np.random.default_rng(rows)
    values = rng.uniform(0, 1, (rows, 50, 2)).astype(np.float32)
    values[:, 0] = 0.0
    found = np.asarray(nearest_index(jnp.asarray(values)))
    assert found.shape == (50, 2) and found.max() < rows
    taken = np.take_along_axis(values, found[None], axis=0)[0]
    np.testing.assert_array_less(taken, values.min(axis=0) * (1 + 2 * rows / 2**23) + 1e-30)
    clear = np.full((rows, 1), 2.0, np.float32)
    clear[rows // 2] = 1.0
    assert int(nearest_index(jnp.asarray(clear))[0]) == rows // 2
    assert int(nearest_index(jnp.full((rows, 1), jnp.nan))[0]) < rows


@pytest.mark.release
def test_distance_gradient_points_away_from_the_closest_point(body):
    """Derivatives go through the triangle that was taken, as of the exact search."""
    mesh = body.rest_mesh()
    v = np.asarray(mesh.vertices)
    points = (v[::600] + np.array([0.01, 0.02, 0.015])).astype(np.float32)
    near = jnp.asarray(nearby_faces(v, np.asarray(mesh.faces), points, neighbours=8))
    p = jnp.asarray(points)

    def squared(p):
        return jnp.sum(closest_among(mesh, p, near).squared_distance)

    hit = closest_among(mesh, p, near)
    foot = jnp.einsum("pk,pkc->pc", hit.weights, mesh.vertices[mesh.faces[hit.face]])
    np.testing.assert_allclose(
        np.asarray(jax.grad(squared)(p)), np.asarray(2.0 * (p - foot)), atol=1e-5
    )


@pytest.mark.parametrize("size", [1e-2, 1e-3, 1e-4])
def test_closest_point_on_a_small_triangle_is_inside_it(size):
    """Only what has no area to speak of counts as a line: a millimetre of cloth has one."""
    corners = jnp.asarray([[0, 0, 0], [size, 0, 0], [0, size, 0]], jnp.float32)
    p = jnp.asarray([0.25 * size, 0.25 * size, size], jnp.float32)
    weights, squared = closest_barycentric(*(x[:, None] for x in (p, *corners)))
    np.testing.assert_allclose(np.asarray(weights)[:, 0], [0.5, 0.25, 0.25], atol=1e-3)
    assert float(squared[0]) == pytest.approx(size**2, rel=1e-3)


def test_signs_are_correct_near_a_sharp_edge():
    """Beyond the edge of a wedge a point lies behind the plane of one of its sides."""
    wedge = trimesh.Trimesh(
        [[0, 0, 0], [0, 0, 1], [1, 0.1, 0.5], [1, -0.1, 0.5]],
        [[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]],
    )
    wedge.fix_normals()
    mesh = make_mesh(wedge.vertices, wedge.faces)
    points = np.random.default_rng(2).uniform([-0.5, -0.4, -0.2], [1.2, 0.4, 1.2], (600, 3))
    height = np.einsum(
        "fc,pfc->pf", wedge.face_normals, points[:, None] - wedge.triangles[None, :, 0]
    )
    clear = np.abs(height).min(axis=1) > 1e-3
    ours = np.asarray(signed_distance(mesh, jnp.asarray(points, jnp.float32)))
    assert ((ours < 0) == (height < 0).all(axis=1))[clear].all()


@pytest.mark.parametrize("count", [1, 3])
def test_nearest_distinct_are_the_first_of_a_sort_without_repetitions(count):
    rng = np.random.default_rng(0)
    worth = rng.permutation(40).astype(np.float32)
    labels = rng.integers(0, 40, (9, 5, 2))
    found = nearest_distinct(jnp.asarray(worth[labels]), jnp.asarray(labels), count)
    assert found.shape == (count, 5, 2)
    for i, j in np.ndindex(5, 2):
        own = np.unique(labels[:, i, j])
        np.testing.assert_array_equal(found[:, i, j], own[np.argsort(worth[own])][:count])
    # Fewer labels than are wanted: the first row's fills up.
    few = nearest_distinct(jnp.zeros((4, 1)), jnp.full((4, 1), 7), 3)
    np.testing.assert_array_equal(few[:, 0], [7, 7, 7])


def test_several_searches_in_one_pass_are_the_searches():
    rng = np.random.default_rng(1)
    a, b = (jnp.asarray(rng.random((17, 6)), jnp.float32) for _ in range(2))
    for both, one in zip(nearest_indices(a, b), (nearest_index(a), nearest_index(b)), strict=True):
        np.testing.assert_array_equal(both, one)
    mapped = jax.vmap(nearest_indices)(a[None], b[None])
    np.testing.assert_array_equal(mapped[1][0], nearest_index(b))
