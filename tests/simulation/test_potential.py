"""The incremental potential: closed forms, invariances, and the step that minimises it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physxnet_jax.body import load_body
from physxnet_jax.garment import Fabric, square_sheet
from physxnet_jax.simulation import (
    XPBD,
    Implicit,
    Scene,
    State,
    advance,
    incremental_potential,
    make_system,
    prepare_scene,
)
from physxnet_jax.simulation.effects import Bend, BodyContact, Gravity, Membrane, Stretch

SOFT = Fabric(stretch=300.0, bend=1e-5, warp=300.0, weft=300.0, shear=50.0)
H = 1.0 / 30.0


def sheet(*effects, solver=None):
    g = square_sheet(5, 0.3, fabric=SOFT)
    scene = prepare_scene(Scene((g,), (Gravity(), *effects)))
    system = make_system(scene, XPBD() if solver is None else solver)
    rest = jnp.asarray(scene.assembly.rest, system.inverse_mass.dtype)[:, :, None]
    return system, rest


def test_free_fall_has_none_and_a_displaced_sheet_its_inertia():
    system, rest = sheet()
    velocity = jnp.broadcast_to(jnp.array([0.3, 0.0, -0.2])[None, :, None], rest.shape)
    fall = jnp.array([0.0, -9.81, 0.0])[None, :, None]
    there = rest + H * (velocity + H * fall)
    least = incremental_potential(system, there, rest, velocity, length=H)
    np.testing.assert_allclose(least, 0.0, atol=1e-9)
    away = jnp.array([0.01, 0.02, 0.0])[None, :, None]
    found = incremental_potential(system, there + away, rest, velocity, length=H)
    mass = float(jnp.sum(1.0 / system.inverse_mass))
    np.testing.assert_allclose(found, [mass * 5e-4 / (2 * H * H)], rtol=1e-4)


@pytest.mark.parametrize("effects", [(Stretch(), Bend()), (Membrane(), Bend())])
def test_potential_is_the_same_for_a_moved_and_turned_sheet(effects):
    system, rest = sheet(*effects)
    rng = np.random.default_rng(0)
    x, before = (rest + jnp.asarray(rng.normal(0, 0.01, rest.shape), rest.dtype) for _ in range(2))
    velocity = jnp.asarray(rng.normal(0, 1, rest.shape), rest.dtype)
    plain = incremental_potential(system, x, before, velocity, length=H)
    assert float(plain[0]) > 0
    # About the vertical axis, which gravity doesn't tell from others.
    turn = jnp.array([[0.6, 0.0, 0.8], [0.0, 1.0, 0.0], [-0.8, 0.0, 0.6]])
    rotated = [jnp.einsum("ij,vjb->vib", turn, a, precision="highest") for a in (x, before)]
    spun = jnp.einsum("ij,vjb->vib", turn, velocity, precision="highest")
    far = jnp.array([40.0, 3.0, -70.0])[None, :, None]
    moved = [a + far for a in rotated]
    same = incremental_potential(system, *moved, spun, length=H)
    np.testing.assert_allclose(same, plain, rtol=2e-3)
    # A sheet that is stretched on the way isn't the same.
    other = incremental_potential(system, 1.1 * x, before, velocity, length=H)
    assert abs(float(other[0] / plain[0]) - 1.0) > 0.1


def test_members_of_a_batch_are_independent_and_contact_has_no_part():
    system, rest = sheet(Stretch(), Bend())
    rng = np.random.default_rng(1)
    x, before, velocity = (
        rest + jnp.asarray(rng.normal(0, 0.01, (len(rest), 3, 3)), rest.dtype) for _ in range(3)
    )
    together = incremental_potential(system, x, before, velocity, length=H)
    alone = [
        incremental_potential(system, *(a[..., k : k + 1] for a in (x, before, velocity)), length=H)
        for k in range(3)
    ]
    np.testing.assert_allclose(together, np.concatenate(alone), rtol=1e-5)
    touching, _ = sheet(Stretch(), Bend(), BodyContact())
    same = incremental_potential(touching, x, before, velocity, length=H)
    np.testing.assert_allclose(same, together, rtol=1e-5)


@pytest.mark.release
def test_a_step_of_backward_euler_minimises_it():
    solver = Implicit(1, 1, "float64", order=1, newton=40, tolerance=1e-12)
    with jax.enable_x64():
        system, rest = sheet(Membrane(compression=1.0), Bend(), solver=solver)
        start = 1.02 * rest
        velocity = jnp.asarray(np.random.default_rng(2).normal(0, 0.1, rest.shape))
        body = load_body()
        q, p = jnp.asarray(body.a_pose(), jnp.float64), jnp.zeros((1, 3))
        state, positions, _ = advance(
            system,
            State(start, velocity),
            jnp.stack([q, q])[:, None],
            jnp.stack([p, p]),
            solver=solver,
            fps=30.0,
        )

        def slope(x):
            return jax.grad(
                lambda a: incremental_potential(system, a, start, velocity, length=H).sum()
            )(x)

        there, elsewhere = (jnp.abs(slope(x)).max() for x in (positions[-1], start))
    assert float(there) < 1e-4 * float(elsewhere)
    assert bool(jnp.isfinite(state.position).all())


@pytest.mark.release
def test_gradient_agrees_with_differences_and_is_finite_where_cloth_collapses():
    with jax.enable_x64():
        solver = XPBD(precision="float64")
        system, rest = sheet(Membrane(), Bend(), solver=solver)
        rng = np.random.default_rng(3)
        x = rest + jnp.asarray(rng.normal(0, 0.005, rest.shape))
        way = jnp.asarray(rng.normal(0, 1, rest.shape))

        def value(a):
            return incremental_potential(system, a, rest, 0.0 * rest, length=H).sum()

        slope = jnp.sum(jax.grad(value)(x) * way)
        step = 1e-6
        difference = (value(x + step * way) - value(x - step * way)) / (2 * step)
        np.testing.assert_allclose(slope, difference, rtol=1e-5)
        assert bool(jnp.isfinite(jax.grad(value)(0.0 * rest)).all())
