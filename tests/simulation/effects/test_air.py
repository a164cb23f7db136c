"""Air: terminal velocity, wind that carries, gusts, seeded turbulence."""

import jax.numpy as jnp
import numpy as np
import pytest

from physxnet_jax.garment import Fabric, square_sheet, template
from physxnet_jax.simulation import (
    XPBD,
    Clock,
    Implicit,
    PosedPoints,
    Scene,
    prepare_scene,
    settle_on_static_body,
)
from physxnet_jax.simulation.effects import (
    TURBULENCE_PERIOD,
    Air,
    Bend,
    Gravity,
    Membrane,
    Pin,
    Stretch,
)

SOLVER = XPBD(32, 4)
STIFF = Fabric(stretch=2000.0, bend=1e-2)


FALL = (Gravity(),)


def roll(air, frames, effects=FALL, n=6):
    scene = prepare_scene(Scene((square_sheet(n, 0.3, fabric=STIFF),), (*effects, air)))
    return settle_on_static_body(scene, frames, solver=SOLVER)


def test_level_sheet_falls_at_its_terminal_velocity():
    """v = sqrt(2 m g / (rho A C)) for a plate across the flow."""
    out = roll(Air(), 60)
    y = out.positions[0][:, :, 1].mean(axis=1)
    expected = np.sqrt(2 * 0.15 * 9.81 / (1.2 * 1.2))
    assert (y[-2] - y[-1]) * 30.0 == pytest.approx(expected, rel=0.02)


def test_still_air_does_not_move_resting_cloth():
    out = roll(Air(), 5, (Stretch(), Bend()))
    x = out.positions[0]
    assert np.abs(x[-1] - x[0]).max() < 1e-6


def test_wind_moves_a_free_sheet_in_its_direction():
    out = roll(Air(wind=(0.0, 4.0, 0.0)), 60, ())
    v = (out.positions[0][-1] - out.positions[0][-2]).mean(axis=0) * 30.0
    assert 3.0 < v[1] < 4.0 and np.abs(v[[0, 2]]).max() < 1e-3


def test_gusts_increase_the_displacement_of_a_sheet():
    steady = roll(Air(wind=(0.0, 3.0, 0.0)), 15, ()).positions[0][:, :, 1].mean(axis=1)
    up = roll(Air(wind=(0.0, 3.0, 0.0), gust=0.8), 15, ()).positions[0][:, :, 1].mean(axis=1)
    assert up[-1] - steady[-1] > 0.02


@pytest.mark.release
def test_turbulence_is_seeded_and_has_the_requested_strength():
    a, b, c = (
        roll(Air(turbulence=2.0, seed=s), 8, (Stretch(), Bend())).positions[0] for s in (1, 1, 2)
    )
    np.testing.assert_array_equal(a, b)
    assert np.abs(a[-1] - c[-1]).max() > 1e-3
    scene = prepare_scene(Scene((square_sheet(40, 5.0),), (Air(turbulence=2.0),)))
    base = jnp.asarray(scene.assembly.rest, jnp.float32)[:, :, None]
    clock = Clock(jnp.float32(0.3), 0.01)
    wind = np.asarray(scene.effects[0].begin(base, None, None, clock, ())[1])
    assert np.sqrt((wind**2).sum(axis=1).mean()) == pytest.approx(2.0, rel=0.35)


def test_hurricane_cloth_is_finite_and_not_much_faster_than_the_wind():
    out = roll(Air(wind=(0.0, 300.0, 0.0)), 10, (Gravity(), Stretch(), Bend()))
    assert out.finite.all() and out.diagnostics["speed_max"].max() < 330.0


@pytest.mark.release
def test_body_shelters_cloth_on_its_lee_side(body, rest):
    """Wind from behind: the front of a top is sheltered near the skin, its back isn't."""
    scene = prepare_scene(Scene((template("top"),), (Air(wind=(0.0, 0.0, 10.0)),)))
    (air,) = scene.effects
    x = scene.assembly.rest.astype(np.float32)
    skin = PosedPoints(air.lee.skin.rest[:, :, None], air.lee.skin.normals[:, :, None])
    clock = Clock(jnp.float32(0.0), 0.01)
    blown = np.asarray(air.begin(jnp.asarray(x)[:, :, None], skin, skin, clock, ())[1])[:, 2, 0]
    trunk = np.abs(x[:, 0]) < 0.1
    front, back = trunk & (x[:, 2] > 0.08), trunk & (x[:, 2] < -0.05)
    assert front.sum() > 100 and back.sum() > 100
    assert np.median(blown[front]) < 4.0 and np.median(blown[back]) > 9.9
    # Farther from the skin it blows again, and all at once it never changes.
    far = jnp.asarray(x + np.float32([0.0, 0.0, 0.3]))[:, :, None]
    assert np.asarray(air.begin(far, skin, skin, clock, ())[1])[front, 2, 0].min() > 9.9
    off = Scene((template("top"),), (Air(wind=(0.0, 0.0, 10.0), shelter=0.0),))
    assert prepare_scene(off).effects[0].lee is None


def test_cloth_away_from_the_body_or_without_wind_has_no_lee():
    sheet = square_sheet(5, 0.3, corner=(2.0, 0.0, 0.0))
    (air,) = prepare_scene(Scene((sheet,), (Air(wind=(0.0, 4.0, 0.0)),))).effects
    assert air.lee is None and air.skinned_points is None
    (still,) = prepare_scene(Scene((template("top"),), (Air(turbulence=1.0),))).effects
    assert still.lee is None


@pytest.mark.nightly
@pytest.mark.parametrize("solver", [XPBD(32, 4), Implicit(8, 4), Implicit(16, 4, order=1)])
@pytest.mark.parametrize("stretch", [Stretch(), Membrane()])
def test_flag_strain_is_bounded_in_a_storm(solver, stretch):
    """Taut cloth resists across its tension too: without that part implicit steps burst."""
    flag = square_sheet(12, 0.4, upright=True, pinned=np.arange(12))
    for speed in (8.0, 15.0):
        effects = (Gravity(), Air(wind=(0.0, 0.0, speed)), stretch, Bend(), Pin())
        out = settle_on_static_body(prepare_scene(Scene((flag,), effects)), 15, solver=solver)
        assert out.finite.all() and out.diagnostics["speed_max"].max() < 3 * speed
        assert out.diagnostics["strain_p99"].max() < 0.8


def blown(air, time, shift=(0.0, 0.0, 0.0)):
    """The wind at the vertices of a sheet at a time [m/s]."""
    (effect,) = prepare_scene(
        Scene((square_sheet(12, 1.0, corner=(3.0, 0.0, 0.0)),), (air,))
    ).effects
    rest = np.asarray(square_sheet(12, 1.0, corner=(3.0, 0.0, 0.0)).mesh.vertices)
    base = jnp.asarray(rest + np.asarray(shift), jnp.float32)[:, :, None]
    wind = effect.begin(base, None, None, Clock(jnp.float32(time), 0.01), ())[1]
    return np.asarray(wind)[:, :, 0]


@pytest.mark.parametrize("tangent", [0.02, 0.2])
def test_wind_along_a_sheet_drags_by_the_tangential_coefficient(tangent):
    """Edge-on: du/dt = -k u^2 with k = rho C_t / (2 density), so u = u0 / (1 + k u0 t)."""
    out = roll(Air(wind=(4.0, 0.0, 0.0), tangent=tangent), 60, effects=())
    v = (out.positions[0][-1] - out.positions[0][-2])[:, 0].mean() * 30.0
    k = 1.2 * tangent / (2 * 0.15)
    assert v == pytest.approx(4.0 - 4.0 / (1 + k * 4.0 * (60 - 0.5) / 30.0), rel=0.02)


@pytest.mark.parametrize("period", [0.5, 4.0])
def test_gust_is_strongest_after_a_quarter_period(period):
    air = Air(wind=(0.0, 3.0, 0.0), gust=0.8, period=period)
    for share, swell in ((0.0, 1.0), (0.25, 1.8), (0.5, 1.0), (0.75, 0.2)):
        np.testing.assert_allclose(blown(air, share * period)[:, 1], 3.0 * swell, atol=1e-4)


def test_turbulence_moves_with_the_wind():
    """What was here blows a metre downwind after a twentieth of a second at 20 m/s."""
    air = Air(wind=(20.0, 0.0, 0.0), turbulence=0.1)
    mean = np.array([20.0, 0.0, 0.0])
    first, there, here = (
        blown(air, t, s) - mean for t, s in ((0.0, (0, 0, 0)), (0.05, (1, 0, 0)), (0.05, (0, 0, 0)))
    )
    size = np.sqrt(np.mean(first**2))
    assert np.sqrt(np.mean((there - first) ** 2)) < 0.4 * size
    assert np.sqrt(np.mean((here - first) ** 2)) > 0.8 * size


@pytest.mark.parametrize("eddy", [0.1, 0.5, 4.0])
def test_turbulence_repeats_in_space(eddy):
    """So that a person who walks far can be computed near the origin."""
    air = Air(turbulence=1.0, eddy=eddy)
    here, again, elsewhere = (
        blown(air, 0.4, (0.0, 0.0, s)) for s in (0.0, TURBULENCE_PERIOD, 0.4 * TURBULENCE_PERIOD)
    )
    np.testing.assert_allclose(again, here, atol=2e-3)
    assert np.abs(elsewhere - here).max() > 0.1


def test_wind_changes_within_a_frame():
    """Frames of a second: all of a gust's half period lies in one."""
    scene = prepare_scene(
        Scene((square_sheet(4, 0.3, fabric=STIFF),), (Air(wind=(0.0, 1.0, 0.0), gust=1.0),))
    )
    steady = prepare_scene(
        Scene((square_sheet(4, 0.3, fabric=STIFF),), (Air(wind=(0.0, 1.0, 0.0)),))
    )
    a, b = (
        settle_on_static_body(s, 1, solver=XPBD(64, 16), fps=1.0).positions[0][0][:, 1].mean()
        for s in (scene, steady)
    )
    assert a > 1.1 * b
