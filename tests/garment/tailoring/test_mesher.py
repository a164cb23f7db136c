"""Panels are filled with even triangles, and their borders are kept."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from physxnet_jax.errors import MeshError
from physxnet_jax.garment.tailoring._flatten import flatten, nearest_triangle
from physxnet_jax.garment.tailoring._mesher import (
    distance_to_polygon,
    mesh_polygon,
    points_in_polygon,
)


def ring(corners, spacing):
    corners = np.asarray(corners, float)
    out = []
    for a, b in zip(corners, np.roll(corners, -1, axis=0)):
        n = max(1, round(float(np.linalg.norm(b - a)) / spacing))
        out.append(a + np.arange(n)[:, None] / n * (b - a))
    return np.concatenate(out)


def angles(p, faces):
    p = np.column_stack([p, np.zeros(len(p))]) if p.shape[1] == 2 else p
    out = []
    for k in range(3):
        a, b, c = (p[faces[:, (k + j) % 3]] for j in range(3))
        u, w = b - a, c - a
        cos = (u * w).sum(axis=1) / (np.linalg.norm(u, axis=1) * np.linalg.norm(w, axis=1))
        out.append(np.degrees(np.arccos(np.clip(cos, -1, 1))))
    return np.stack(out, axis=1)


def area(p, faces):
    a, b, c = (p[faces[:, k]] for k in range(3))
    return 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])


@settings(max_examples=15, deadline=None)
@given(st.floats(0.2, 1.0), st.floats(0.2, 1.0), st.floats(0.0, 0.6), st.floats(0.03, 0.06))
def test_polygon_is_filled_with_even_triangles(width, height, lean, spacing):
    border = ring([[0, 0], [width, 0], [width + lean * height, height], [0, height]], spacing)
    p, faces = mesh_polygon(border, spacing)
    assert np.array_equal(p[: len(border)], border)
    assert (area(p, faces) > 0).all()
    assert area(p, faces).sum() == pytest.approx((width + 0.5 * lean * height) * height)
    sides = {(k, (k + 1) % len(border)) for k in range(len(border))}
    edges = {tuple(e) for f in faces for e in (f[[0, 1]], f[[1, 2]], f[[2, 0]])}
    assert sides <= edges
    assert np.quantile(angles(p, faces).min(axis=1), 0.1) > 30.0


def test_same_border_gives_the_same_mesh():
    border = ring([[0, 0], [0.3, 0], [0.4, 0.5], [0, 0.4]], 0.03)
    one, two = mesh_polygon(border, 0.03), mesh_polygon(border, 0.03)
    assert np.array_equal(one[0], two[0]) and np.array_equal(one[1], two[1])


def test_a_border_that_can_not_be_kept_is_refused():
    crossed = ring([[0, 0], [1, 1], [1, 0], [0, 1]], 0.2)
    with pytest.raises(MeshError, match="crosses itself"):
        mesh_polygon(crossed, 0.2)


def test_inside_and_distance_of_a_square():
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])
    p = np.array([[0.5, 0.25], [1.5, 0.5], [-0.1, -0.1], [0.9, 0.5]])
    assert points_in_polygon(p, square).tolist() == [True, False, False, True]
    assert distance_to_polygon(p, square) == pytest.approx([0.25, 0.5, 0.02**0.5, 0.1])


def test_a_cylinder_flattens_without_stretch_and_a_sphere_does_not():
    border = ring([[0, 0], [1.2, 0], [1.2, 1], [0, 1]], 0.08)
    p, faces = mesh_polygon(border, 0.08)
    around = np.column_stack([np.cos(p[:, 0]), p[:, 1], np.sin(p[:, 0])])
    ball = np.column_stack(
        [np.cos(p[:, 0]) * np.cos(p[:, 1]), np.sin(p[:, 1]), np.sin(p[:, 0]) * np.cos(p[:, 1])]
    )

    def stretch(solid):
        flat = flatten(solid, faces, p * [0.7, 1.3], steps=200)
        e = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
        long = np.linalg.norm(solid[e[:, 0]] - solid[e[:, 1]], axis=1)
        return np.abs(np.linalg.norm(flat[e[:, 0]] - flat[e[:, 1]], axis=1) / long - 1).max()

    assert stretch(around) < 2e-3
    assert stretch(ball) > 0.02


def test_barycentric_coordinates_reproduce_places_inside_and_beyond():
    border = ring([[0, 0], [1, 0], [1, 1], [0, 1]], 0.2)
    p, faces = mesh_polygon(border, 0.2)
    nodes = np.array([[0.31, 0.47], [0.99, 0.5], [1.1, 0.5]])
    near, share = nearest_triangle(nodes, p, faces)
    assert np.einsum("nk,nkc->nc", share, p[faces[near]]) == pytest.approx(nodes)
    assert (share[:2] >= -1e-9).all() and share[2].min() < 0
