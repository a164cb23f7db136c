"""Relief of the skin: a tip on a plane, whose height is known."""

import numpy as np
import pytest

from physxnet_jax.garment import template
from physxnet_jax.simulation import Scene, prepare_scene
from physxnet_jax.simulation.effects import BodyContact
from physxnet_jax.simulation.effects._relief import relief


def plane(tip: float) -> tuple[np.ndarray, np.ndarray]:
    """A grid with edges of 5 mm whose middle rises by ``tip``, and its normals."""
    a = 0.005 * np.arange(-5, 6)
    x = np.stack([*np.meshgrid(a, a, indexing="ij"), np.zeros((11, 11))], axis=-1).reshape(-1, 3)
    x[60, 2] = tip
    return x, np.tile([0.0, 0.0, 1.0], (len(x), 1))


@pytest.mark.parametrize(("tip", "rise"), [(0.003, 0.003), (0.02, 0.006), (-0.003, 0.0)])
def test_skin_around_a_tip_has_its_height_up_to_a_limit(tip, rise):
    x, n = plane(tip)
    out = relief(x, n, 0.012)
    away = np.linalg.norm(x - x[60], axis=1)
    near = (away < 0.0119) & (away > 0)
    np.testing.assert_allclose(out[near], rise, atol=1e-12)
    assert (out[away > 0.013] == 0).all()
    assert out[60] == pytest.approx(max(-tip, 0.0)), "from a pit, its edge rises"


def test_skin_that_faces_away_is_not_relief():
    x, n = plane(0.0)
    lid = x + [0.0, 0.0, 0.004]
    both, normals = np.concatenate([x, lid]), np.concatenate([n, -n])
    assert relief(both, normals, 0.012).max() == 0.0
    assert relief(both, np.concatenate([n, n]), 0.012).max() == pytest.approx(0.004)


def test_cloth_of_small_triangles_lies_over_less():
    g = template("dress")
    heights = []
    for spacing in (BodyContact().sample_spacing, 0.015):
        (contact,) = prepare_scene(Scene((g,), (BodyContact(sample_spacing=spacing),))).effects
        heights.append(float(np.mean(contact.relief)))
    assert 0 < heights[1] < heights[0] < 0.003, "larger triangles lie over more"
