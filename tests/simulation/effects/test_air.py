"""Air: terminal velocity, wind that carries, gusts, seeded turbulence."""

import numpy as np
import pytest

from physxnet_jax.garment import Fabric, square_sheet
from physxnet_jax.simulation import (
    XPBD,
    Air,
    Bend,
    Gravity,
    Scene,
    Stretch,
    prepare_scene,
    simulate_still,
)

SOLVER = XPBD(32, 4)
STIFF = Fabric(stretch=2000.0, bend=1e-2)


FALL = (Gravity(),)


def roll(air, frames, effects=FALL, n=6):
    scene = prepare_scene(Scene((square_sheet(n, 0.3, fabric=STIFF),), (*effects, air)))
    return simulate_still(scene, frames, solver=SOLVER)


def test_a_level_sheet_falls_at_its_terminal_velocity():
    """v = sqrt(2 m g / (rho A C)) for a plate across the flow."""
    out = roll(Air(), 60)
    y = out.positions[0][:, :, 1].mean(axis=1)
    expected = np.sqrt(2 * 0.15 * 9.81 / (1.2 * 1.2))
    assert (y[-2] - y[-1]) * 30.0 == pytest.approx(expected, rel=0.02)


def test_still_air_does_nothing_to_what_stands_still():
    out = roll(Air(), 5, (Stretch(), Bend()))
    x = out.positions[0]
    assert np.abs(x[-1] - x[0]).max() < 1e-6


def test_wind_carries_a_free_sheet_along_in_its_direction():
    out = roll(Air(wind=(0.0, 4.0, 0.0)), 60, ())
    v = (out.positions[0][-1] - out.positions[0][-2]).mean(axis=0) * 30.0
    assert 3.0 < v[1] < 4.0 and np.abs(v[[0, 2]]).max() < 1e-3


def test_a_gust_swells_and_fades():
    steady = roll(Air(wind=(0.0, 3.0, 0.0)), 15, ()).positions[0][:, :, 1].mean(axis=1)
    up = roll(Air(wind=(0.0, 3.0, 0.0), gust=0.8), 15, ()).positions[0][:, :, 1].mean(axis=1)
    assert up[-1] - steady[-1] > 0.02


def test_turbulence_is_decided_by_its_seed_and_of_the_size_asked_for():
    a, b, c = (
        roll(Air(turbulence=2.0, seed=s), 8, (Stretch(), Bend())).positions[0] for s in (1, 1, 2)
    )
    np.testing.assert_array_equal(a, b)
    assert np.abs(a[-1] - c[-1]).max() > 1e-3
    scene = prepare_scene(Scene((square_sheet(40, 5.0),), (Air(turbulence=2.0),)))
    import jax.numpy as jnp

    from physxnet_jax.simulation import Clock

    base = jnp.asarray(scene.assembly.rest, jnp.float32)[:, :, None]
    clock = Clock(jnp.float32(0.3), 0.01)
    wind = np.asarray(scene.effects[0].begin(base, None, None, clock, ())[1])
    assert np.sqrt((wind**2).sum(axis=1).mean()) == pytest.approx(2.0, rel=0.35)


def test_a_hurricane_stays_finite_and_no_faster_than_itself():
    out = roll(Air(wind=(0.0, 300.0, 0.0)), 10, (Gravity(), Stretch(), Bend()))
    assert out.finite.all() and out.diagnostics["speed_max"].max() < 330.0
