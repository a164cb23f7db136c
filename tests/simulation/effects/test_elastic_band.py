"""Elastic bands pull like rubber, hold garments up, and do nothing where they are slack."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physxnet_jax.garment import Fabric, free_garment, tailor
from physxnet_jax.motion import load_motion
from physxnet_jax.simulation import (
    PRESETS,
    XPBD,
    Clock,
    Scene,
    prepare_scene,
    settle_on_static_body,
    simulate_batch,
    standard_effects,
)
from physxnet_jax.simulation.effects import Elastic, Gravity, Pin, Stretch

LIGHT = Fabric(density=0.1, stretch=1.0, bend=1e-6)


def strip(elastic=True, pinned=(0, 1)):
    """Two triangles that hang by one side; the band runs down the other way."""
    v = np.array([[0, 5, 0], [0.1, 5, 0], [0, 4.8, 0], [0.1, 4.8, 0]], float)
    g = free_garment(v, np.array([[0, 2, 1], [1, 2, 3]]), pinned=np.array(pinned), fabric=LIGHT)
    loops = {"band": jnp.array([[0, 2], [1, 3]], jnp.int32)}
    return dataclasses.replace(g, loops=loops, elastic=("band",) if elastic else ())


def energies(garment, effect, stretch):
    scene = prepare_scene(Scene((garment,), (effect,)))
    moved = scene.assembly.rest * [1.0, stretch, 1.0]
    band = scene.effects[0]
    clock = Clock(jnp.asarray(0.0), 1.0)
    context = band.begin(jnp.asarray(moved, jnp.float32)[..., None], None, None, clock, ())
    return float(band.energy(jnp.zeros((4, 3, 1)), context)[0]), band, context


@pytest.mark.parametrize(("stretch", "gathered"), [(1.0, 0.25), (1.3, 0.25), (1.3, 0.0)])
def test_energy_is_that_of_two_springs(stretch, gathered):
    found, _, _ = energies(strip(), Elastic(gathered=gathered, tension=40.0), stretch)
    own = 0.2 * (1 - gathered)
    longer = max(0.2 * stretch - own, 0.0)
    assert found == pytest.approx(2 * 0.5 * 40.0 / own * longer**2, rel=1e-4)


def test_slack_bands_neither_push_nor_store_energy():
    found, band, context = energies(strip(), Elastic(gathered=0.25), 0.5)
    assert found == 0.0
    rest = jnp.zeros((4, 3, 1))
    slope = jax.grad(lambda d: band.energy(d, context)[0])(rest)
    assert np.array_equal(slope, np.zeros((4, 3, 1)))


def test_an_absent_band_changes_no_bit():
    def run(effects):
        scene = prepare_scene(Scene((strip(elastic=False),), effects))
        return settle_on_static_body(scene, 3, solver=XPBD(16, 1)).positions[0]

    usual = (Gravity(), Stretch(), Pin())
    assert np.array_equal(run(usual), run((Gravity(), Stretch(), Elastic(), Pin())))


def test_a_weight_hangs_where_tension_carries_it():
    garment = strip()
    scene = prepare_scene(Scene((garment,), (Gravity(), Elastic(gathered=0.0, tension=2.0), Pin())))
    mass = scene.assembly.mass[2:].sum()
    out = settle_on_static_body(scene, 240, solver=XPBD(64, 1), velocity=None)
    heights = 5.0 - out.positions[0][-60:, 2:, 1].mean()
    # Undamped it swings about the point where the springs carry the weight.
    expected = 0.2 * (1 + 0.5 * mass * 9.81 / 2.0)
    assert heights == pytest.approx(expected, rel=0.03)


@pytest.mark.nightly
def test_a_strapless_top_stays_up_by_its_band_alone():
    """Its negative control is the same top without the effect."""
    motion = load_motion("jump", fps=30.0)
    motion = dataclasses.replace(motion, rotations=motion.rotations[:50], root=motion.root[:50])
    garment = tailor("strapless")
    top = np.unique(np.asarray(garment.loops["top"]))
    held = tailor("strapless", hold=("top",))

    def run(worn, effects):
        scene = prepare_scene(Scene((worn,), effects))
        (out,) = simulate_batch(scene, [motion], solver=PRESETS["standard"])
        return out.positions[0][:, top].mean(axis=1)

    usual = standard_effects((garment,))
    where = run(held, standard_effects((held,)))
    by_band = np.linalg.norm(run(garment, usual) - where, axis=1).max()
    without = tuple(e for e in usual if not isinstance(e, Elastic))
    fallen = np.linalg.norm(run(garment, without) - where, axis=1).max()
    assert by_band < 0.04 < 0.08 < fallen
