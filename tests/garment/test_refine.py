"""Refined garments: same vertices first, everything else between them."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from physxnet_jax.body import load_body
from physxnet_jax.errors import MeshError
from physxnet_jax.garment import free_garment, refine_garment, square_sheet, template
from physxnet_jax.geometry import closest_points, make_mesh, mesh_edges


@pytest.mark.release
def test_vertices_stay_edges_shorten_and_everything_is_interpolated():
    coarse = template("bottom")
    fine = refine_garment(coarse, 0.012)
    n = coarse.num_vertices
    assert fine.num_vertices > 2 * n
    x = np.asarray(fine.mesh.vertices)
    ends = mesh_edges(np.asarray(fine.mesh.faces)).vertices
    assert np.linalg.norm(x[ends[:, 0]] - x[ends[:, 1]], axis=1).max() <= 0.012
    np.testing.assert_array_equal(x[:n], np.asarray(coarse.mesh.vertices))
    np.testing.assert_allclose(np.asarray(fine.skin).sum(axis=1), 1.0, atol=1e-5)
    body = load_body()
    heavy = body.rest_vertices(body.shape(weight_up=1.0))
    rest = body.rest_vertices(body.default_shape())
    other, same = np.asarray(fine.rest_vertices(heavy)), np.asarray(fine.rest_vertices(rest))
    np.testing.assert_allclose(same, x, atol=2e-5)
    np.testing.assert_allclose(other[:n], np.asarray(coarse.rest_vertices(heavy)), atol=1e-5)
    # New vertices lie on the coarse triangles on this body and on another.
    for shape, moved in ((rest, same), (heavy, other)):
        corners = np.asarray(coarse.rest_vertices(shape))
        distance = closest_points(make_mesh(corners, coarse.mesh.faces), jnp.asarray(moved[n:]))
        assert float(distance.squared_distance.max()) < (2e-4) ** 2


def test_a_band_of_held_vertices_has_no_holes():
    top = template("top")
    x = np.asarray(top.mesh.vertices)
    held = x[:, 1] > np.quantile(x[:, 1], 0.9)
    fine = refine_garment(dataclasses.replace(top, pinned=jnp.asarray(held)), 0.012)
    faces = held[np.asarray(top.mesh.faces)].all(axis=1)
    band = make_mesh(x, np.asarray(top.mesh.faces)[faces])
    away = closest_points(band, fine.mesh.vertices).squared_distance
    inside = np.asarray(away) < 1e-12
    assert (np.asarray(fine.pinned)[inside]).all() and inside.sum() > held.sum()


def test_only_vertices_between_held_ones_are_held():
    held = square_sheet(3, 0.2, pinned=np.arange(3))
    fine = refine_garment(held, 0.03)
    x, pinned = np.asarray(fine.mesh.vertices), np.asarray(fine.pinned)
    edge = np.asarray(held.mesh.vertices)[:3]
    on_edge = np.abs(x - edge[0]) @ (np.abs(edge[2] - edge[0]) < 1e-9) < 1e-6
    np.testing.assert_array_equal(pinned, on_edge)
    assert pinned.sum() > 3


def test_triangles_without_area_and_impossible_lengths():
    v = np.asarray([[0, 0, 0], [0.1, 0, 0], [0.2, 0, 0], [0, 0.1, 0]], float) + [0, 0, 1.5]
    sheet = square_sheet(2, 0.2)
    fine = refine_garment(free_garment(v, np.asarray([[0, 1, 2], [0, 2, 3]])), 0.04)
    for field in ("skin", "offset", "ref_weights"):
        assert np.isfinite(np.asarray(getattr(fine, field))).all()
    same = refine_garment(sheet, 1.0)
    assert same.num_vertices == 4
    with pytest.raises(MeshError, match="vertices"):
        refine_garment(sheet, 1e-5)
    assert jnp.all(same.mesh.vertices == sheet.mesh.vertices)
