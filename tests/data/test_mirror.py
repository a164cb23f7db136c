"""Mirrored actions: what a mirror shows, of motion and of cloth."""

import numpy as np
import pytest

from physxnet_jax.body import load_body
from physxnet_jax.data import Sequence, mirrored_offsets, mirrored_sequence
from physxnet_jax.garment import TEMPLATES, template
from physxnet_jax.motion import load_motion

FLIP = np.diag([-1.0, 1.0, 1.0])
FIELD = np.array([[0.1, 0.2, -0.1], [0.0, 0.1, 0.3], [0.2, -0.2, 0.1]])


@pytest.mark.release
@pytest.mark.parametrize("name", TEMPLATES)
def test_mirrored_linear_field_matches_the_closed_form(name):
    """Offsets A x at x become F A F x: blending corners is exact for what is linear."""
    rest = np.asarray(template(name).mesh.vertices, np.float64)
    told = np.float32(np.stack([rest @ FIELD.T, -2.0 * rest @ FIELD.T]))
    seen = mirrored_offsets(template(name), told)
    wanted = rest @ (FLIP @ FIELD @ FLIP).T
    away = np.abs(seen - np.stack([wanted, -2.0 * wanted]))
    # As far apart as the halves of the template are.
    assert away.mean() < 1e-5 and away.max() < 2e-3
    # No mirror at all: left and right stay where they were.
    assert np.abs(told[0] - wanted).max() > 0.05


def test_motion_and_cloth_are_mirrored_together():
    body, motion = load_body(), load_motion("walk")
    rng = np.random.default_rng(0)
    count = template("top").num_vertices
    offsets = rng.normal(0.0, 0.01, (motion.num_frames, count, 3)).astype(np.float32)
    told = Sequence("walk", "train", motion, {"top": offsets}, {"top": {"finite": True}})
    twin = mirrored_sequence(body, told)
    assert (twin.name, twin.split, twin.meta) == (told.name, told.split, told.meta)
    np.testing.assert_allclose(twin.motion.root, np.asarray(motion.root) * [-1.0, 1.0, 1.0])
    np.testing.assert_array_equal(twin.offsets["top"], mirrored_offsets(template("top"), offsets))
    back = mirrored_sequence(body, twin)
    np.testing.assert_allclose(back.motion.root, motion.root)
