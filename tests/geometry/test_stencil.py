"""Means over neighbourhoods: what they keep, and where they stop."""

import pathlib
import runpy

import jax.numpy as jnp
import numpy as np
import pytest

from physxnet_jax.geometry import Stencil, gaussian_smoothing, gaussian_stencil, spread_points

sheet = runpy.run_path(str(pathlib.Path(__file__).parents[1] / "samples.py"))["sheet"]


def test_stencil_keeps_constants_and_reduces_noise():
    v, f = sheet(20)
    s = gaussian_stencil(v, f, 0.03)
    np.testing.assert_allclose(np.asarray(s.weight.sum(axis=1)), 1.0, atol=1e-6)
    one = jnp.ones((3, len(v), 2))
    np.testing.assert_allclose(np.asarray(s @ one), 1.0, atol=1e-6)
    noise = np.random.default_rng(0).normal(size=(len(v), 1)).astype(np.float32)
    assert float(jnp.std(s @ (s @ jnp.asarray(noise)))) < 0.3


def test_batched_stencil_matches_a_loop():
    v, f = sheet(8)
    s = gaussian_stencil(v, f, 0.02)
    x = jnp.asarray(np.random.default_rng(1).normal(size=(4, len(v), 3)).astype(np.float32))
    each = jnp.stack([s @ row for row in x])
    np.testing.assert_allclose(np.asarray(s @ x), np.asarray(each), atol=1e-6)


def test_nearby_disconnected_sheet_is_excluded():
    v, f = sheet(6)
    both = np.concatenate([v, v + [0.0, 0.0, 0.001]])
    s = gaussian_stencil(both, np.concatenate([f, f + len(v)]), 0.03)
    values = jnp.concatenate([jnp.zeros((len(v), 1)), jnp.ones((len(v), 1))])
    np.testing.assert_allclose(np.asarray(s @ values), np.asarray(values), atol=1e-6)


def test_of_fine_meshes_a_few_vertices_are_sampled():
    """As near to the Gaussian mean, and no mixing of sheets that lie upon each other."""
    v, f = sheet(72, 0.002)
    both = np.concatenate([v, v + [0.0, 0.0, 0.001], [[5.0, 5.0, 5.0]]])
    s = gaussian_stencil(both, np.concatenate([f, f + len(v)]), 0.03)
    assert len(np.unique(np.asarray(s.index)[:-1])) < len(both) / 8
    np.testing.assert_allclose(np.asarray(s @ jnp.ones((len(both), 1))), 1.0, atol=1e-6)
    sides = jnp.concatenate([jnp.zeros((len(v), 1)), jnp.ones((len(v) + 1, 1))])
    np.testing.assert_allclose(np.asarray(s @ sides), np.asarray(sides), atol=1e-6)
    # The control: a coarse mesh of so many vertices samples them all.
    wide = gaussian_stencil(*sheet(95, 0.02), 0.03)
    assert len(np.unique(np.asarray(wide.index))) == 95**2
    wave = np.sin(20.0 * both[:, 0])
    middle = np.flatnonzero(np.abs(both[:, :2] - 0.071).max(axis=1) < 0.02)
    # Paths go along the grid, and along one diagonal of its squares.
    gap = both[middle][:, None] - both[None]
    x, y = np.abs(gap[..., 0]), np.abs(gap[..., 1])
    cut = np.maximum(x, y) + (np.sqrt(2.0) - 1.0) * np.minimum(x, y)
    far = np.where(gap[..., 0] * gap[..., 1] < 0, cut, x + y)
    weight = np.exp(-0.5 * (far / 0.03) ** 2) * (far < 0.066) * (np.abs(gap[..., 2]) < 5e-4)
    exact = weight @ wave / weight.sum(axis=1)
    found = np.asarray(s @ jnp.asarray(wave[:, None], jnp.float32))[middle, 0]
    assert np.sqrt(np.mean((found - exact) ** 2)) < 0.1 < np.abs(wave[middle] - exact).max()


def test_isolated_vertices_keep_values_and_coincident_ones_share_them():
    v = np.zeros((4, 3))
    s = gaussian_stencil(v, np.array([[0, 1, 2]]), 0.01)
    out = np.asarray(s @ jnp.asarray([[0.0], [3.0], [6.0], [9.0]]))
    np.testing.assert_allclose(out.ravel(), [3.0, 3.0, 3.0, 9.0], atol=1e-5)
    assert isinstance(s, Stencil)


@pytest.mark.parametrize("step", [0.02, 0.01, 0.004])
def test_smoothing_is_smooth_at_any_mesh_resolution(step):
    v, f = sheet(24, step)
    smoothing = gaussian_smoothing(v, f, 0.03)
    assert len(smoothing.stencils) <= 5
    np.testing.assert_allclose(np.asarray(smoothing @ jnp.ones((len(v), 1))), 1.0, atol=1e-6)
    noise = jnp.asarray(np.random.default_rng(0).normal(size=(len(v), 1)).astype(np.float32))

    def lumps(values):
        """Second differences along rows, over what is left of the noise."""
        rows = np.asarray(values).reshape(24, 24)
        return np.abs(np.diff(rows, 2, axis=1)).mean() / rows.std()

    alone = gaussian_stencil(v, f, 0.03)
    assert lumps(smoothing @ noise) < 0.6 * lumps(alone @ (alone @ noise))


def test_smoothing_at_mesh_resolution_is_one_stencil():
    v, f = sheet(12, 0.02)
    (only,) = gaussian_smoothing(v, f, 0.015).stencils
    np.testing.assert_array_equal(only.index, gaussian_stencil(v, f, 0.015).index)


@pytest.mark.parametrize("spacing", [0.05, 0.3])
def test_spread_points_are_separated_and_cover_all_points(spacing):
    p = np.random.default_rng(2).uniform(size=(300, 3))
    chosen = p[spread_points(p, spacing)]
    gaps = np.linalg.norm(chosen[:, None] - chosen[None], axis=2) + np.eye(len(chosen))
    assert gaps.min() > spacing * (1 - 1e-9)
    assert np.linalg.norm(p[:, None] - chosen[None], axis=2).min(axis=1).max() <= spacing
