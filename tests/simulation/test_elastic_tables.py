"""Tables of several garments hold the energy of each one's own simulation."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physxnet_jax.garment import Fabric, square_sheet
from physxnet_jax.simulation import (
    XPBD,
    Scene,
    elastic_tables,
    incremental_potential,
    make_system,
    prepare_scene,
)
from physxnet_jax.simulation.effects import Bend, Stretch

SHEETS = (
    square_sheet(5, 0.3, fabric=Fabric(stretch=300.0, bend=1e-5)),
    square_sheet(7, 0.2, fabric=Fabric(stretch=900.0, bend=4e-5)),
)
LENGTH = 1.0 / 30.0


@pytest.fixture(scope="module")
def tables():
    return elastic_tables(SHEETS, [None, None])


def crumpled(sheet, seed):
    rest = np.asarray(sheet.mesh.vertices)
    return rest + np.random.default_rng(seed).normal(0, 0.01, rest.shape)


def one(tables, k):
    return jax.tree.map(lambda x: x[k], tables)


def padded(x, tables):
    most = int(max(t.max() for t in (tables.ends, tables.corners))) + 1
    return jnp.asarray(np.pad(x, [(0, most - len(x)), (0, 0)]), jnp.float32)


@pytest.mark.release
@pytest.mark.parametrize("k", [0, 1])
def test_energy_is_that_of_the_effects(tables, k):
    scene = prepare_scene(Scene((SHEETS[k],), (Stretch(), Bend())))
    system = make_system(scene, XPBD())
    x = crumpled(SHEETS[k], k)
    batch = jnp.asarray(x, system.inverse_mass.dtype)[:, :, None]
    # Without inertia: the sheet is where it was.
    wanted = incremental_potential(system, batch, batch, jnp.zeros_like(batch), length=LENGTH)
    found = one(tables, k).energy(padded(x, tables))
    np.testing.assert_allclose(found, wanted[0], rtol=1e-4)
    assert float(found) > 0


def test_moved_and_turned_sheets_have_the_same_energy_and_flat_ones_none(tables):
    x = crumpled(SHEETS[0], 3)
    turn = np.array([[0.6, 0.0, 0.8], [0.0, 1.0, 0.0], [-0.8, 0.0, 0.6]])
    table = one(tables, 0)
    plain, moved, flat = (
        float(table.energy(padded(y, tables)))
        for y in (x, x @ turn.T + [2.0, 0.0, 1.0], np.asarray(SHEETS[0].mesh.vertices))
    )
    assert moved == pytest.approx(plain, rel=1e-3) and flat < 1e-6 * plain
    # Compressed edges are softer than stretched ones.
    wide, narrow = (
        float(table.energy(padded(s * np.asarray(SHEETS[0].mesh.vertices), tables)))
        for s in (1.05, 0.95)
    )
    assert narrow == pytest.approx(0.2 * wide, rel=1e-3)


def test_padding_has_no_energy_and_no_slope(tables):
    assert tables.ends.shape[0] == 2 and float(tables.stretch[0].min()) == 0.0
    x = padded(crumpled(SHEETS[0], 1), tables)
    count = SHEETS[0].num_vertices
    energy, slope = jax.value_and_grad(one(tables, 0).energy)(x)
    elsewhere = x.at[count:].set(7.0)
    assert float(one(tables, 0).energy(elsewhere)) == float(energy)
    assert not np.asarray(slope[count:]).any() and np.isfinite(slope).all()
    stiff = dataclasses.replace(one(tables, 0), stretch=2.0 * tables.stretch[0])
    assert float(stiff.energy(x)) > float(energy)


def test_slopes_are_finite_where_an_edge_has_no_length(tables):
    x = jnp.zeros((int(tables.ends.max()) + 1, 3))
    assert np.isfinite(jax.grad(one(tables, 1).energy)(x)).all()


def test_lifting_takes_weight_times_height(tables):
    area = np.array([0.3**2, 0.2**2])
    densities = np.array([s.fabric.density for s in SHEETS])
    np.testing.assert_allclose(tables.lift(0.01), 9.81 * 0.01 * area * densities, rtol=1e-5)
