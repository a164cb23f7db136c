"""Garments lifted out of the skin at rest."""

import numpy as np
import pytest

from physxnet_jax.body import load_body
from physxnet_jax.garment import _fit, template

NEAREST = 0.004


@pytest.mark.parametrize("fine", [False, True], ids=["every vertex", "at sites"])
def test_lifted_garments_clear_the_skin_and_the_rest_stays(fine, monkeypatch):
    """Whether every vertex is moved, or a fine mesh follows a coarse one."""
    if fine:
        monkeypatch.setattr(_fit, "FINE_MESH", 2_000)
        monkeypatch.setattr(_fit, "NUM_SITES", 1_000)
    body = load_body()
    skin, garment = body.rest_mesh(), template("bottom")
    faces, start = np.asarray(garment.mesh.faces), np.array(garment.mesh.vertices)
    # A dent of 22 mm over the left thigh.
    middle = start[np.argmax(start[:, 0])]
    near = np.linalg.norm(start - middle, axis=1)
    _, away = _fit.clearance(skin, start)
    dented = start - 0.022 * np.exp(-((near / 0.05) ** 2))[:, None] * away
    before, _ = _fit.clearance(skin, dented)
    assert before.min() < -0.002
    lifted, low = _fit.lift_out(skin, dented, faces, NEAREST)
    after, _ = _fit.clearance(skin, lifted)
    np.testing.assert_array_equal(low, before < NEAREST)
    assert after.min() > NEAREST - 0.0005
    still = before >= 3 * NEAREST
    np.testing.assert_array_equal(lifted[still], dented[still])
