"""Metrics of folds and motion, in closed form."""

import numpy as np
import pytest

from physxnet_jax.evaluation import (
    acceleration_error,
    area_strain,
    dihedral_angles,
    fold_spectrum,
    fold_strength,
    jitter,
    spectrum_distance,
    wrinkle_error,
)
from physxnet_jax.garment import square_sheet

# Two triangles that share the edge from (0, 0) to (0, 1).
FACES = np.array([[0, 1, 2], [1, 0, 3]])


def folded(angle):
    return np.array(
        [[0, 0, 0], [0, 1, 0], [-1, 0.5, 0], [np.cos(angle), 0.5, np.sin(angle)]], np.float32
    )


@pytest.mark.parametrize("angle", [0.0, 0.4, -0.4, 1.5, -3.0])
def test_dihedral_angle_of_a_fold_is_exact(angle):
    seen = dihedral_angles(FACES, folded(angle)[None])
    assert abs(seen[0, 0]) == pytest.approx(abs(angle), abs=1e-6)
    assert np.sign(seen[0, 0]) == np.sign(angle) * np.sign(dihedral_angles(FACES, folded(1)[None]))


def test_wrinkle_error_is_invariant_to_translation():
    x = np.stack([folded(a) for a in (0.1, 0.5, 1.0)])
    assert wrinkle_error(FACES, x + 5.0, x) < 1e-3
    assert wrinkle_error(FACES, np.stack([folded(0.0)] * 3), np.stack([folded(0.5)] * 3)) == (
        pytest.approx(np.degrees(0.5), rel=1e-4)
    )
    # Past a half turn the short way counts.
    gap = wrinkle_error(FACES, folded(3.1)[None], folded(-3.1)[None])
    assert gap == pytest.approx(np.degrees(2 * np.pi - 6.2), rel=1e-3)


@pytest.mark.parametrize("angle", [0.0, 0.4, -1.5])
def test_fold_strength_is_the_fold_angle_at_any_position(angle):
    x = np.stack([folded(angle), folded(angle) + 3.0, folded(-angle)])
    assert fold_strength(FACES, x) == pytest.approx(np.degrees(abs(angle)), abs=1e-3)
    assert fold_strength(FACES, np.stack([folded(0.3), folded(0.0)])) == pytest.approx(
        np.degrees(0.3) / np.sqrt(2.0), rel=1e-4
    )


def test_area_strain_of_a_stretched_sheet_is_exact():
    sheet = square_sheet(4)
    x, faces = np.asarray(sheet.mesh.vertices), np.asarray(sheet.mesh.faces)
    out = area_strain(x, faces, np.stack([x, x * np.float32(1.1)]))
    np.testing.assert_allclose(out[0], 0.0, atol=1e-6)
    np.testing.assert_allclose(out[1], 0.21, atol=1e-5)


def test_jerk_and_acceleration_of_polynomials_are_exact():
    t = np.arange(12) / 30.0
    x = np.zeros((12, 2, 3))
    x[:, 0, 1] = t**3
    assert jitter(x, 30.0) == pytest.approx(0.5 * 6.0, rel=1e-6), "one of two moves"
    y = np.zeros_like(x)
    y[:, :, 2] = (t**2)[:, None]
    assert acceleration_error(y, np.zeros_like(y), 30.0) == pytest.approx(2.0, rel=1e-6)
    assert jitter(y, 30.0) < 1e-6
    assert jitter(x[:3], 30.0) == 0.0 and acceleration_error(x[:2], x[:2], 30.0) == 0.0


@pytest.mark.parametrize(("wavelength", "band"), [(0.14, 0), (0.07, 1), (0.035, 2)])
def test_folds_are_found_at_their_length(wavelength, band):
    n, side = 81, 0.56
    u, v = np.meshgrid(np.linspace(0, side, n), np.linspace(0, side, n), indexing="ij")
    rest = np.stack([u.ravel(), np.zeros(n * n), v.ravel()], 1)
    at = np.arange(n * n).reshape(n, n)
    a, b, c, d = (q.ravel() for q in (at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    folded = rest.copy()
    folded[:, 1] = 0.002 * np.cos(2.0 * np.pi * rest[:, 0] / wavelength)
    power = fold_spectrum(rest, faces, folded[None])
    assert np.argmax(power) == band and power[band] > 0.38 * power.sum()
    # Half as high folds have a quarter of the power at all lengths.
    folded[:, 1] *= 0.5
    half = fold_spectrum(rest, faces, folded[None])
    assert spectrum_distance(half, power) == pytest.approx(np.log(4.0), rel=0.1)
    assert spectrum_distance(power, power) == 0.0
