"""Bending by a polynomial: it conserves momentum and agrees with the implicit step."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physxnet_jax.garment import FABRICS, Fabric, square_sheet, template, with_fabric
from physxnet_jax.simulation import XPBD, Clock, Scene, prepare_scene, settle_on_static_body
from physxnet_jax.simulation._effect import Step
from physxnet_jax.simulation.effects import Bend, Gravity, Pin, Stretch
from physxnet_jax.simulation.effects._bend import _chebyshev

CLOCK = Clock(jnp.float32(0.0), 0.1)


def one_step(garment, h, noise):
    """Rest positions with noise, the displacement of one projection, and masses."""
    scene = prepare_scene(Scene((garment,), (Bend(),)))
    bend = scene.effects[0].at_step(h)
    x = scene.assembly.rest + np.random.default_rng(0).normal(0.0, noise, scene.assembly.rest.shape)
    base = jnp.asarray(x, jnp.float32)[:, :, None]
    context = bend.begin(base, None, None, CLOCK, None)
    zero = jnp.zeros_like(base)
    moved = bend.project(zero, zero, context, jnp.float32(1.0), Step(h, 1.0))
    energy = [float(bend.energy(d, context)[0]) for d in (zero, moved)]
    return np.asarray(base[..., 0], np.float64), np.asarray(moved[..., 0]), scene, energy


@pytest.mark.parametrize("fabric", ["silk", "denim"])
@pytest.mark.parametrize("h", [1 / 240, 1 / 1440])
def test_bending_conserves_linear_and_angular_momentum(fabric, h):
    x, d, scene, energy = one_step(with_fabric(template("bottom"), fabric), h, 0.003)
    push = scene.assembly.mass[:, None] * d
    assert np.abs(push.sum(axis=0)).max() < 1e-6 * np.abs(push).sum()
    turn = np.cross(x - x.mean(axis=0), push)
    assert np.abs(turn.sum(axis=0)).max() < 1e-5 * np.abs(turn).sum()
    assert energy[1] < 0.9 * energy[0]


@pytest.mark.parametrize("degree", [1, 2, 5, 32])
def test_polynomial_follows_the_implicit_step_and_stays_small(degree):
    stages, limit = _chebyshev(degree)
    size = np.linspace(0.0, limit, 500)
    before = moved = np.zeros_like(size)
    for old, new in stages:
        moved, before = old * moved + (1.0 - old) * before - new * size * (1.0 + moved), moved
    answer = 1.0 + moved
    # Below -0.1 a rough mode would grow; smooth ones follow 1 / (1 + size).
    assert answer.min() > -0.1 - 1e-6 and answer.max() <= 1.0 + 1e-6
    smooth = size < 0.2
    assert np.abs(answer - 1.0 / (1.0 + size))[smooth].max() < 0.05


@pytest.mark.release
@pytest.mark.parametrize("fabric", ["silk", "denim"])
def test_sag_of_a_strip_hardly_depends_on_the_number_of_substeps(fabric):
    """Stiff cloth isn't softer with few substeps, or limp cloth stiffer."""
    n = 9
    g = square_sheet(n, 0.12, pinned=np.arange(2 * n), fabric=FABRICS[fabric])
    scene = prepare_scene(Scene((g,), (Gravity(), Stretch(), Bend(), Pin())))
    sag = [
        float(-settle_on_static_body(scene, 2, solver=XPBD(s, 1)).positions[0][-1][-n:, 1].mean())
        for s in (16, 128)
    ]
    flat = float(-np.asarray(g.mesh.vertices)[-n:, 1].mean())
    assert (sag[0] - flat) == pytest.approx(sag[1] - flat, rel=0.15)


def test_stiffness_factors_known_and_traced_agree():
    g = square_sheet(6, 0.2, fabric=Fabric(bend=2e-5))
    (bend,) = prepare_scene(Scene((g,), (Bend(),))).effects
    x = jnp.asarray(
        np.asarray(g.mesh.vertices) + 0.01 * np.random.default_rng(0).normal(size=(36, 3))
    )
    base = x.astype(jnp.float32)[:, :, None]

    def moved(factor):
        e = bend.rescaled({"bend": factor}).at_step(1 / 480)
        zero = jnp.zeros_like(base)
        return e.project(
            zero, zero, e.begin(base, None, None, CLOCK, None), jnp.float32(1.0), Step(1 / 480, 1.0)
        )

    known, traced = moved(8.0), jax.jit(moved)(jnp.float32(8.0))
    plain = moved(1.0)
    gap = float(jnp.abs(known - traced).max())
    assert gap < 0.1 * float(jnp.abs(known - plain).max())
