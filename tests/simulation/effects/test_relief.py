"""Relief of the skin: spheres and tips, whose rise over flat triangles is known."""

import dataclasses

import numpy as np
import pytest

from physxnet_jax.garment import refine_garment, template
from physxnet_jax.simulation import Scene, prepare_scene
from physxnet_jax.simulation.effects import BodyContact
from physxnet_jax.simulation.effects._relief import relief


def plane(tip: float) -> tuple[np.ndarray, np.ndarray]:
    """A grid with edges of 5 mm whose middle rises by ``tip``, and its normals."""
    a = 0.005 * np.arange(-5, 6)
    x = np.stack([*np.meshgrid(a, a, indexing="ij"), np.zeros((11, 11))], axis=-1).reshape(-1, 3)
    x[60, 2] = tip
    return x, np.tile([0.0, 0.0, 1.0], (len(x), 1))


@pytest.mark.parametrize(("tip", "rise"), [(0.003, 0.003), (0.011, 0.010)])
def test_corners_within_reach_of_a_tip_lie_as_high_up_to_a_limit(tip, rise):
    x, n = plane(tip)
    out = relief(x, n, 0.016)
    away = np.linalg.norm(x - x[60], axis=1)
    np.testing.assert_allclose(out[away < 0.0159], rise, atol=1e-12)
    assert (out[away > 0.0165] == 0).all()


@pytest.mark.release
@pytest.mark.parametrize("radius", [0.05, 0.1])
def test_on_a_sphere_it_is_the_sag_of_a_chord(radius):
    rng = np.random.default_rng(0)
    n = rng.normal(size=(20000, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    reach = 0.016
    out = relief(radius * n, n, reach)
    # Distances from 0.6 to 1 of the reach, by area.
    sag = reach**2 * (1 + 0.6**2) / 2 / (2 * radius)
    assert np.median(out) == pytest.approx(sag, rel=0.1)


def test_hollows_and_skin_that_faces_away_are_not_relief():
    x, n = plane(0.0)
    bowl = x + np.column_stack([0 * x[:, :2], 4.0 * (x**2).sum(axis=1)])
    inner = np.abs(x[:, :2]).max(axis=1) < 0.006
    assert relief(bowl, n, 0.012)[inner].max() == 0.0
    lid = x + [0.0, 0.0, 0.004]
    both, normals = np.concatenate([x, lid]), np.concatenate([n, -n])
    assert relief(both, normals, 0.012).max() == pytest.approx(0.0, abs=1e-12)


def test_small_triangles_lie_lower_than_large_ones():
    heights = []
    for spacing in (BodyContact().sample_spacing, 0.015):
        scene = Scene((template("dress"),), (BodyContact(sample_spacing=spacing),))
        (contact,) = prepare_scene(scene).effects
        heights.append(float(np.mean(contact.relief)))
    assert 0 < heights[1] < heights[0] < 0.004


@pytest.mark.release
def test_each_garment_of_a_scene_has_the_relief_of_its_own_triangles():
    coarse, fine = template("dress"), refine_garment(template("bottom"), 0.012)
    plain = dataclasses.replace(fine, coarse_faces=None)
    effects = (BodyContact(),)
    (alone,) = prepare_scene(Scene((coarse,), effects)).effects
    (both,) = prepare_scene(Scene((plain, coarse), effects)).effects
    (refined,) = prepare_scene(Scene((fine, coarse), effects)).effects
    means = [[float(np.mean(c.relief[:, k])) for k in range(2)] for c in (both, refined)]
    assert means[0][1] == pytest.approx(float(np.mean(alone.relief)), rel=0.3)
    assert means[0][0] < 0.6 * means[0][1], "short edges"
    assert means[1][0] > 1.5 * means[0][0], "the triangles that come back are the coarse ones"
    assert set(np.unique(both.part)) == {0, 1} and len(both.part) >= fine.num_vertices
