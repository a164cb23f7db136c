"""Cloth beside a reference: equal cloth is alike in everything, each fault shows in its measure."""

import numpy as np
import pytest

from physxnet_jax.evaluation import likeness
from physxnet_jax.garment import square_sheet
from physxnet_jax.simulation import Scene, prepare_scene
from physxnet_jax.simulation.effects import Stretch


@pytest.fixture(scope="module")
def moving():
    """A waving sheet of 30 frames."""
    assembly = prepare_scene(Scene((square_sheet(24, 0.5),), (Stretch(),))).assembly
    rest = np.asarray(assembly.rest)
    time = np.arange(30)[:, None] / 30.0
    x = np.repeat(rest[None], 30, axis=0)
    x[..., 1] += 0.02 * np.sin(30.0 * rest[None, :, 0] + 8.0 * time)
    return assembly, x.astype(np.float32)


def test_equal_cloth_is_alike_in_everything(moving):
    assembly, x = moving
    found = likeness(assembly, x, x, fps=30.0)
    assert (found.rmse_mm, found.wrinkle_deg, found.spectrum) == (0.0, 0.0, 0.0)
    assert (found.folds, found.tension, found.jerk) == (1.0, 1.0, 1.0)


def test_ratios_to_nothing_are_nan(moving):
    assembly, x = moving
    still = np.repeat(np.asarray(assembly.rest)[None], 5, axis=0).astype(np.float32)
    found = likeness(assembly, x[:5], still, fps=30.0)
    assert np.isnan(found.jerk) and np.isfinite(found.rmse_mm)


def test_each_fault_shows_in_its_measure(moving):
    assembly, x = moving
    aside = likeness(assembly, x + np.float32([0.01, 0.0, 0.0]), x, fps=30.0)
    assert aside.rmse_mm == pytest.approx(10.0, rel=1e-4)
    assert aside.folds == pytest.approx(1.0, rel=1e-3) and aside.wrinkle_deg < 0.1
    flat = x.copy()
    flat[..., 1] = x[..., 1].mean()
    ironed = likeness(assembly, flat + 1e-4 * (x - flat), x, fps=30.0)
    assert ironed.folds < 0.01 and ironed.wrinkle_deg > 1.0 and ironed.spectrum > 2.0
    wide = likeness(assembly, 1.2 * x, x, fps=30.0)
    assert wide.tension > 1.5
    rough = x + np.random.default_rng(0).normal(0, 0.002, x.shape).astype(np.float32)
    noisy = likeness(assembly, rough, x, fps=30.0)
    assert noisy.jerk > 3.0 and noisy.folds > 1.1 and noisy.rmse_mm < 5.0
