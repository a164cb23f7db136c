"""Other shapes, cuts and fabrics of the same dresser, and gradients by them."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physxnet_jax.dressing import (
    Inference,
    Simulation,
    clothe,
    make_dresser,
    with_cut,
    with_fabric,
    with_shape,
)
from physxnet_jax.errors import PhysXNetError, SimulationError
from physxnet_jax.garment import cut_vertices, tailor
from physxnet_jax.simulation.effects import PreparedGuide

NANO = Inference(weights="nano")


@pytest.fixture(scope="module")
def guided():
    return make_dresser(
        ["shorts"], method="guided", inference=NANO, simulation=Simulation(substeps=4)
    )


@pytest.mark.release
def test_a_cut_replaces_the_rest_shape_of_its_garment():
    dresser = make_dresser(["shorts", "tee"], inference=NANO)
    wide = cut_vertices("shorts", {"ease": 0.2})
    new = with_cut(dresser, {"shorts": wide})
    known = {w.name: w for w in new.worn}
    np.testing.assert_array_equal(known["shorts"].rest, wide)
    np.testing.assert_array_equal(known["tee"].rest, dresser.worn[1].rest)
    lengths = [float(d.strain.constraints[0].length[0].sum()) for d in (new, dresser)]
    assert lengths[0] > lengths[1]
    with pytest.raises(PhysXNetError, match=r"No garment 'skirt' is worn, only"):
        with_cut(dresser, {"skirt": wide})
    with pytest.raises(PhysXNetError, match="vertices for a mesh of"):
        with_cut(dresser, {"tee": wide})


@pytest.mark.release
def test_only_simulated_cloth_has_a_fabric(guided):
    with pytest.raises(PhysXNetError, match="guided"):
        with_fabric(make_dresser(["shorts"], inference=NANO), bend=2.0)
    with pytest.raises(SimulationError, match="Unknown parameter weight"):
        with_fabric(guided, weight=2.0)
    softer = with_fabric(guided, stretch=0.5).guided.system.effects
    for one, two in zip(softer, guided.guided.system.effects, strict=True):
        if "stretch" in one.materials:
            np.testing.assert_allclose(
                one.springs.compliance, 2.0 * two.springs.compliance, rtol=1e-6
            )


@pytest.mark.nightly
def test_guided_cloth_of_another_shape_is_near_that_of_a_new_dresser(motion):
    """And far from that of the shape before."""
    near = Inference(weights="small")
    guided = make_dresser(
        ["shorts"], method="guided", inference=near, simulation=Simulation(substeps=4)
    )
    shape = guided.body.shape(weight_up=0.6, height_up=0.5)
    # Not cut for that person: the same garment, moved to the shape.
    anew = make_dresser(
        [tailor("shorts")],
        method="guided",
        inference=near,
        simulation=Simulation(substeps=4),
        shape=shape,
    )
    # Three frames: later, folds go ways of their own.
    q, p = (x[:3] for x in motion)
    cloth = jax.jit(lambda d: clothe(d, q, p, 30.0)["shorts"][-1])
    same = with_shape(guided, shape)
    wanted = cloth(anew)
    # A new dresser chooses other patches to draw, which is most of the difference.
    patches = same.guided.system.effects
    patches = tuple(
        b if isinstance(b, PreparedGuide) else a
        for a, b in zip(patches, anew.guided.system.effects, strict=True)
    )
    system = dataclasses.replace(same.guided.system, effects=patches)
    alike = dataclasses.replace(same, guided=dataclasses.replace(same.guided, system=system))
    off, off_alike, moved = (
        float(jnp.abs(cloth(d) - wanted).mean()) for d in (same, alike, guided)
    )
    assert off_alike < 0.03 * moved and off < 0.5 * moved and moved > 3e-3


@pytest.mark.nightly
def test_gradients_by_pose_shape_cut_and_fabric_match_differences(guided, motion, slope_error):
    """In float64, within a thousandth: the whole way from a pose to the simulated cloth."""
    # What the tailor cuts is float32: its slope is taken once.
    cut, slope = jax.jvp(
        lambda ease: cut_vertices("shorts", {"ease": ease}, like={}),
        (jnp.float32(0.1),),
        (jnp.float32(1.0),),
    )
    with jax.enable_x64(True):

        def wide(tree):
            return jax.tree.map(
                lambda x: x.astype("float64") if jnp.issubdtype(x.dtype, jnp.floating) else x, tree
            )

        person = wide(guided)
        solver = dataclasses.replace(person.guided.solver, precision="float64")
        person = dataclasses.replace(
            person, guided=dataclasses.replace(person.guided, solver=solver)
        )
        q, p = wide(tuple(x[2:] for x in motion))
        rng = np.random.default_rng(0)
        way = jnp.asarray(rng.normal(0.0, 0.05, person.body.default_shape().shape))
        weight = jnp.asarray(rng.normal(size=person.worn[0].rest.shape))
        hip = person.body.joint("LeftUpLeg")

        @jax.jit
        def loss(a):
            turned = q.at[:, hip, 1].add(a[0])
            turned = turned / jnp.linalg.norm(turned, axis=-1, keepdims=True)
            other = with_shape(person, wide(person.body.default_shape()) + a[1] * way)
            pattern = other.worn[0].rest + wide(cut - guided.worn[0].rest) + a[2] * wide(slope)
            other = with_cut(other, {"shorts": pattern})
            other = with_fabric(other, stretch=1.0 + a[3], bend=1.0 + a[4])
            return jnp.sum(clothe(other, turned, p, 30.0)["shorts"][-1] * weight)

        places = rng.uniform(-0.01, 0.01, (5, 5))
        gradient = jax.jit(jax.grad(loss))
        assert slope_error(loss, gradient, places, (1e-6, 1e-7, 1e-8)) < 1e-3


@pytest.mark.nightly
def test_ease_widens_guided_cloth(guided, motion):
    """The tailor's measure reaches the simulated cloth, with its sign."""

    def girth(ease):
        cloth = with_cut(guided, {"shorts": cut_vertices("shorts", {"ease": ease}, like={})})
        x = clothe(cloth, *motion, 30.0)["shorts"][-1]
        one, other = jnp.asarray(guided.garments[0].loops["hem"]).T
        return jnp.sum(jnp.linalg.norm(x[one] - x[other], axis=1))

    value, slope = jax.jit(lambda e: jax.jvp(girth, (e,), (jnp.ones_like(e),)))(jnp.float32(0.1))
    assert np.isfinite(float(value)) and float(slope) > 0.1
