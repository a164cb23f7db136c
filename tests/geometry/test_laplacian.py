"""The Laplacian of a mesh: exact on linear functions, a wave's eigenvalue on a fine sheet."""

import numpy as np
import pytest

from physxnet_jax.geometry import mesh_laplacian


def sheet(n, length=1.0):
    u, v = np.meshgrid(np.linspace(0, length, n), np.linspace(0, length, n), indexing="ij")
    x = np.stack([u.ravel(), np.zeros(n * n), v.ravel()], 1)
    at = np.arange(n * n).reshape(n, n)
    a, b, c, d = (q.ravel() for q in (at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]))
    return x, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def test_areas_and_constants():
    x, faces = sheet(12, 0.3)
    area, stiffness = mesh_laplacian(x, faces)
    assert area.sum() == pytest.approx(0.09)
    assert np.abs(stiffness @ np.ones(len(x))).max() < 1e-9
    assert np.abs(stiffness - stiffness.T).max() < 1e-12


@pytest.mark.parametrize(("n", "within"), [(31, 0.02), (61, 0.006)])
def test_energy_of_a_wave(n, within):
    """The energy of a wave is k^2 times its square, with an error of second order."""
    x, faces = sheet(n)
    area, stiffness = mesh_laplacian(x, faces)
    k = 4.0 * np.pi
    wave = np.cos(k * x[:, 0])
    assert (wave @ (stiffness @ wave)) / (area * wave**2).sum() == pytest.approx(k**2, rel=within)
