"""Coarse meshes on vertices of fine ones, and values that spread from them."""

import pathlib
import runpy

import numpy as np
import pytest

from physxnet_jax.geometry import coarse_mesh, linear_weights

sheet = runpy.run_path(str(pathlib.Path(__file__).parents[1] / "samples.py"))["sheet"]


def area(v, f):
    a, b, c = np.moveaxis(v[f], 1, 0)
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()


def tube(around, along, radius=0.1, height=0.4):
    k, j = np.meshgrid(np.arange(around), np.arange(along))
    angle = 2.0 * np.pi * k.ravel() / around
    y = height * j.ravel() / (along - 1)
    v = np.column_stack([radius * np.cos(angle), y, radius * np.sin(angle)])
    i = np.arange(around * along).reshape(along, around)
    a, b = i[:-1], np.roll(i, -1, axis=1)[:-1]
    c, d = i[1:], np.roll(i, -1, axis=1)[1:]
    a, b, c, d = (q.ravel() for q in (a, b, c, d))
    return v, np.concatenate([np.column_stack([a, c, b]), np.column_stack([b, c, d])])


@pytest.mark.parametrize("make", [lambda: sheet(60, 0.01), lambda: tube(100, 60)])
def test_coarse_mesh_covers_the_fine_one_with_the_same_side_out(make):
    v, f = make()
    sites, coarse, label = coarse_mesh(v, f, 300)
    assert 0.5 * 300 < len(sites) < 1.5 * 300
    assert len(np.unique(sites)) == len(sites) and (label[sites] == np.arange(len(sites))).all()
    assert area(v[sites], coarse) == pytest.approx(area(v, f), rel=0.05)
    # Every vertex belongs to a site nearby.
    spacing = np.sqrt(area(v, f) / 300)
    assert np.linalg.norm(v - v[sites][label], axis=1).max() < 2.0 * spacing

    def normals(x, faces):
        a, b, c = np.moveaxis(x[faces], 1, 0)
        n = np.cross(b - a, c - a)
        return n / np.linalg.norm(n, axis=1)[:, None], (a + b + c) / 3.0

    fine, middles = normals(v, f)
    ours, where = normals(v[sites], coarse)
    near = np.linalg.norm(where[:, None] - middles[None], axis=2).argmin(axis=1)
    assert (np.einsum("fc,fc->f", ours, fine[near]) > 0.5).mean() > 0.99


def test_preferred_vertices_and_borders_are_sites():
    v, f = sheet(60, 0.01)
    first = np.array([1234, 2500])
    sites, coarse, _ = coarse_mesh(v, f, 300, first)
    assert set(first) <= set(sites)
    # The coarse sheet ends where the fine one does.
    low, high = v[sites[coarse]].reshape(-1, 3).min(axis=0), v[sites[coarse]].max(axis=(0, 1))
    np.testing.assert_allclose([low, high], [v.min(axis=0), v.max(axis=0)], atol=1e-12)


def test_sheets_upon_each_other_have_sites_of_their_own():
    v, f = sheet(40, 0.01)
    loose = [[5.0, 5.0, 5.0]]
    both = np.concatenate([v, v + [0.0, 0.0, 0.001], loose])
    faces = np.concatenate([f, f + len(v)])
    sites, coarse, label = coarse_mesh(both, faces, 400)
    upper = sites >= len(v)
    assert 0.4 < upper.mean() < 0.6
    assert np.ptp(upper[coarse].astype(int), axis=1).max() == 0
    assert (upper[label[:-1]] == (np.arange(2 * len(v)) >= len(v))).all()
    near, weight = linear_weights(both, faces, sites, label)
    # A vertex of no triangle follows nothing.
    assert label[-1] == -1 and not weight[-1].any()
    used = np.abs(weight[:-1]) > 0
    assert (upper[near[:-1]] == (np.arange(2 * len(v)) >= len(v))[:, None])[used].all()


def test_what_is_linear_along_a_mesh_stays_linear():
    v, f = sheet(60, 0.01)
    sites, _, label = coarse_mesh(v, f, 300)
    near, weight = linear_weights(v, f, sites, label)
    np.testing.assert_allclose(weight.sum(axis=1), 1.0, atol=1e-9)
    linear = v @ [[0.3, -1.0], [0.7, 0.2], [0.0, 0.0]] + [1.0, 2.0]
    np.testing.assert_allclose(
        np.einsum("vk,vkc->vc", weight, linear[sites][near]), linear, atol=1e-4
    )
    # The control: the nearest site's own value.
    assert np.abs(linear[sites][label] - linear).max() > 0.01


def test_errors_of_smooth_values_fall_with_the_square_of_the_spacing():
    v, f = tube(200, 120)
    wave = np.sin(v @ [7.0, 9.0, 5.0])
    errors = []
    for count in (300, 1200):
        sites, _, label = coarse_mesh(v, f, count)
        near, weight = linear_weights(v, f, sites, label)
        found = np.einsum("vk,vk->v", weight, wave[sites][near])
        errors.append(np.sqrt(np.mean((found - wave) ** 2)))
    # Half the spacing, a quarter of the error.
    assert errors[0] / errors[1] > 3.0
    assert errors[1] < 0.01


def test_parts_of_few_vertices_are_carried_as_a_whole():
    """A button of four vertices has a site or two: it moves with them."""
    v, f = sheet(40, 0.01)
    button = np.array([[0.2, 0.2, 0.01], [0.202, 0.2, 0.01], [0.2, 0.202, 0.01], [0.2, 0.2, 0.012]])
    every = np.concatenate([v, button])
    faces = np.concatenate([f, len(v) + np.array([[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]])])
    sites, _, label = coarse_mesh(every, faces, 200)
    near, weight = linear_weights(every, faces, sites, label)
    own = np.flatnonzero(sites >= len(v))
    assert len(own) >= 1 and np.isin(near[-4:][weight[-4:] != 0], own).all()
    np.testing.assert_allclose(weight[-4:].sum(axis=1), 1.0, atol=1e-9)
