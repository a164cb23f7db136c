"""A scene reshaped is the scene prepared anew, and differentiable."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physxnet_jax.body import load_body
from physxnet_jax.errors import SimulationError
from physxnet_jax.garment import cut_vertices, tailor
from physxnet_jax.simulation import STANDARD, XPBD, Scene, make_system, prepare_scene
from physxnet_jax.simulation.effects import Air, Elastic, Membrane, Stretch

EFFECTS = (*STANDARD[:-1], Elastic(), STANDARD[-1])
WOVEN = tuple(Membrane() if isinstance(e, Stretch) else e for e in EFFECTS)


def system_of(effects, **measures):
    garment = tailor("trousers", **measures)
    return make_system(prepare_scene(Scene((garment,), effects)), XPBD(8, 1))


@pytest.fixture(scope="module")
def other():
    """Trousers of other ease on the usual mesh."""
    garment = tailor("trousers", ease=0.15)
    np.testing.assert_array_equal(garment.mesh.faces, tailor("trousers").mesh.faces)
    return garment


def floats(effect):
    return [x for x in jax.tree.leaves(effect) if jnp.issubdtype(x.dtype, jnp.floating)]


@pytest.mark.release
@pytest.mark.parametrize("effects", [EFFECTS, WOVEN], ids=["springs", "membrane"])
def test_reshaping_to_the_same_measures_changes_nothing(effects):
    system = system_of(effects)
    body = load_body()
    rest = body.rest_vertices(body.default_shape())
    cloth = tailor("trousers").mesh.vertices
    same = system.reshaped(cloth, rest)
    assert jax.tree.structure(same) == jax.tree.structure(system)
    for one, two in zip(system.effects, same.effects, strict=True):
        for x, y in zip(floats(one), floats(two), strict=True):
            np.testing.assert_allclose(y, x, rtol=2e-3, atol=1e-6 * np.abs(x).max(initial=0.0))
    np.testing.assert_allclose(same.inverse_mass, system.inverse_mass, rtol=1e-4)


@pytest.mark.release
def test_reshaping_gives_the_tables_of_a_new_scene(other):
    """Masses, lengths and stiffnesses; a scene that isn't reshaped has others."""
    rest = load_body().rest_vertices(load_body().default_shape())
    cloth = other.rest_vertices(rest)
    wanted = make_system(prepare_scene(Scene((other,), EFFECTS)), XPBD(8, 1))
    system = system_of(EFFECTS)
    found = system.reshaped(cloth, rest)
    np.testing.assert_allclose(found.inverse_mass, wanted.inverse_mass, rtol=1e-3)
    assert not np.allclose(system.inverse_mass, wanted.inverse_mass, rtol=1e-2)
    springs, anew = found.effects[2].springs, wanted.effects[2].springs
    np.testing.assert_allclose(springs.length, anew.length, rtol=1e-4)
    np.testing.assert_allclose(springs.compliance, anew.compliance, rtol=1e-3)


@pytest.mark.release
def test_lengths_follow_measures_with_their_gradient():
    """The sum of rest lengths by the trousers' ease, against a difference."""
    rest = load_body().rest_vertices(load_body().default_shape())
    system = system_of(EFFECTS)

    def total(ease):
        cloth = cut_vertices("trousers", {"ease": ease}, like={})
        return jnp.sum(system.reshaped(cloth, rest).effects[2].springs.length)

    at = jnp.float32(0.1)
    slope = float(jax.jit(jax.grad(total))(at))
    ends = [float(jax.jit(total)(at + jnp.float32(s))) for s in (0.01, -0.01)]
    assert slope == pytest.approx((ends[0] - ends[1]) / 0.02, rel=0.02)
    assert slope > 1.0


@pytest.mark.release
def test_what_cannot_be_reshaped_is_refused():
    body = load_body()
    rest = body.rest_vertices(body.default_shape())
    system = system_of((*EFFECTS[:-1], Air(wind=(0.0, 0.0, 1.0)), EFFECTS[-1]))
    with pytest.raises(SimulationError, match=r"Air can't be reshaped"):
        system.reshaped(tailor("trousers").mesh.vertices, rest)
