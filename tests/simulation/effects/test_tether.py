"""Tether: hanging cloth stays within its length of where it is snug, and nothing else changes."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physxnet_jax.garment import square_sheet, tailor
from physxnet_jax.simulation import (
    XPBD,
    Scene,
    advance,
    make_system,
    prepare_scene,
    start_state,
)
from physxnet_jax.simulation._effect import Clock, Rest, Step
from physxnet_jax.simulation.effects import Gravity, Pin, Stretch, Tether

SIDE, SIZE, FPS = 13, 0.6, 30.0


def sheet(rest=None):
    """A sheet of which the first row of vertices is snug, and the rest hangs from it."""
    assembly = prepare_scene(Scene((square_sheet(SIDE, SIZE),), (Gravity(),))).assembly
    flat = np.asarray(assembly.rest)
    snug = flat[:, 2] < flat[:, 2].min() + 1e-6
    rest = flat if rest is None else rest(flat)
    return dataclasses.replace(assembly, rest=rest, hanging=~snug)


def tethered(assembly, **settings):
    return Tether(**settings).prepare(assembly, jnp.ones(len(assembly.rest), jnp.float32))


def moved(tether, base, displacement):
    context = tether.begin(base, None, None, Clock(jnp.zeros(()), 0.01), None)
    return tether.project(displacement, displacement, context, jnp.ones(()), Step(0.01, 1.0))


def column(x):
    return jnp.asarray(x, jnp.float32)[:, :, None]


def bent(flat):
    """The sheet around a cylinder, its first row along the axis."""
    angle = (flat[:, 2] - flat[:, 2].min()) / 0.2
    return np.stack([flat[:, 0], 0.2 * np.sin(angle), 0.2 * np.cos(angle)], axis=1)


@pytest.mark.parametrize("shape", [None, bent])
def test_lengths_are_distances_along_the_cloth(shape):
    assembly, flat = sheet(shape), sheet().rest
    tether = tethered(assembly)
    away = flat[:, 2] - flat[:, 2].min()
    np.testing.assert_allclose(tether.length, away, rtol=0.03, atol=1e-6)
    found = flat[np.asarray(tether.anchor)]
    np.testing.assert_allclose(found[:, 2], flat[:, 2].min(), atol=1e-6)
    np.testing.assert_allclose(found[:, 0], flat[:, 0], atol=1e-6)
    if shape is bent:
        # Negative control: straight lines are far shorter.
        assert float(tether.straight.max()) < 0.7 * away.max()


@pytest.mark.parametrize("slack", [0.0, 0.1])
def test_nothing_is_farther_than_its_length_and_nothing_else_is_moved(slack):
    assembly = sheet()
    tether = tethered(assembly, slack=slack)
    base = column(assembly.rest)
    drawn = 0.2 * jax.random.normal(jax.random.key(0), base.shape)
    drawn = jnp.where(jnp.asarray(assembly.hanging)[:, None, None], drawn, 0.0)
    out = moved(tether, base, drawn)

    def far(x):
        at = (base + x)[:, :, 0]
        return jnp.linalg.norm(at - at[tether.anchor], axis=1)

    length = (1.0 + slack) * tethered(assembly).length
    np.testing.assert_allclose(tether.length, length, rtol=1e-6)
    free = np.asarray(far(drawn) <= length)
    assert 10 < free.sum() < len(free) - 10
    np.testing.assert_array_equal(out[free], drawn[free])
    np.testing.assert_allclose(far(out)[~free], length[~free], rtol=1e-5)
    np.testing.assert_array_equal(out[~assembly.hanging], drawn[~assembly.hanging])


def test_gradients_are_finite_where_a_tether_is_taut_and_where_it_has_no_length():
    assembly = sheet()
    tether = tethered(assembly)
    base = column(assembly.rest)
    for start in (jnp.zeros_like(base), -base):
        slope = jax.grad(lambda x: jnp.sum(moved(tether, base, x) ** 2))(start)
        assert bool(jnp.isfinite(slope).all())


def test_it_is_idle_where_nothing_hangs():
    assembly = sheet()
    assert Tether().idle(dataclasses.replace(assembly, hanging=np.zeros(len(assembly.rest), bool)))
    assert not Tether().idle(assembly)


def test_what_has_nothing_higher_does_not_hang():
    low = dataclasses.replace(square_sheet(5, 0.2), template="dress")
    assembly = prepare_scene(Scene((low,), (Gravity(),))).assembly
    assert assembly.rest[:, 1].max() < 0.5
    assert not assembly.hanging.any()


def test_it_changes_with_the_rest_shape():
    assembly = sheet(bent)
    tether = tethered(assembly)
    rest = jnp.asarray(assembly.rest, jnp.float32)
    ones = jnp.ones(len(rest), jnp.float32)
    larger = tether.reshaped(Rest(1.1 * rest, rest, rest, ones))
    np.testing.assert_allclose(larger.length, 1.1 * tether.length, rtol=1e-5)
    np.testing.assert_allclose(larger.straight, 1.1 * tether.straight, rtol=1e-5)


def test_a_skirt_hangs_and_a_bodice_does_not():
    garment = tailor("aline")
    assembly = prepare_scene(Scene((garment,), (Gravity(),))).assembly
    height = assembly.rest[:, 1]
    low, high = np.quantile(height, [0.3, 0.8])
    assert assembly.hanging[height < low].all()
    assert not assembly.hanging[height > high].all()
    slim = prepare_scene(Scene((tailor("slim"),), (Gravity(),))).assembly
    assert slim.hanging.mean() < 0.2


def test_a_swinging_sheet_of_few_substeps_keeps_its_length_with_tethers_alone():
    assembly, flat = sheet(), square_sheet(SIDE, SIZE)
    garment = dataclasses.replace(flat, pinned=~assembly.hanging)
    scene = prepare_scene(Scene((garment,), (Gravity(), Stretch(), Pin())))
    tether = tethered(assembly)
    *others, pin = scene.effects
    x = column(assembly.rest)
    longest = {}
    for effects in ((*others, pin), (*others, tether, pin)):
        solver = XPBD(8, 1)
        system = make_system(dataclasses.replace(scene, effects=effects), solver)
        pose = jnp.broadcast_to(jnp.asarray([1.0, 0.0, 0.0, 0.0]), (25, 1, 31, 4))
        root = jnp.zeros((25, 1, 3), jnp.float32)
        state = start_state(system, x, solver=solver, fps=FPS)
        out = advance(system, state, pose, root, solver=solver, fps=FPS)[1][..., 0]
        assert bool(jnp.isfinite(out).all())
        far = jnp.linalg.norm(out - out[:, tether.anchor], axis=2)
        longest[len(effects)] = float((far / jnp.maximum(tether.length, 0.1)[None]).max()) - 1.0
        assert float(x[0, 1, 0] - out[..., 1].min()) > 0.4, "it swings down"
    assert longest[4] < 0.01 < 0.03 < longest[3]
