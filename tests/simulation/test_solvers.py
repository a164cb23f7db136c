"""Solvers against the float64 reference: order, agreement, gradients, breakdown."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physxnet_jax.errors import SimulationError
from physxnet_jax.garment import Fabric, square_sheet
from physxnet_jax.motion import load_motion
from physxnet_jax.simulation import (
    PRESETS,
    XPBD,
    Effect,
    Implicit,
    Scene,
    State,
    Status,
    Verlet,
    advance,
    make_system,
    prepare_scene,
    settle_on_static_body,
    simulate,
)
from physxnet_jax.simulation._effect import Prepared
from physxnet_jax.simulation.effects import Bend, Dihedral, Gravity, Membrane, Pin, Stretch
from physxnet_jax.typing import pytree

SOFT = Fabric(stretch=300.0, bend=1e-5, warp=300.0, weft=300.0, shear=50.0)


SPRINGS = (Stretch(compression=1.0), Bend())


def swinging(effects=SPRINGS):
    g = square_sheet(6, 0.3, pinned=np.arange(6), fabric=SOFT)
    return prepare_scene(Scene((g,), (Gravity(), *effects, Pin())))


def rms(a, b):
    return float(np.sqrt(((a - b) ** 2).sum(axis=-1).mean()))


def last(scene, solver, frames=5):
    return settle_on_static_body(scene, frames, solver=solver).positions[0][-1].astype(np.float64)


@pytest.fixture(scope="module")
def reference():
    scene = swinging()
    fine, coarse = (last(scene, Verlet(substeps=n, contact_updates=1)) for n in (1024, 512))
    assert rms(fine, coarse) < 1e-7, "the reference agrees with itself"
    return scene, fine


@pytest.mark.release
@pytest.mark.parametrize(
    ("make", "order", "within", "substeps"),
    [
        (lambda n: XPBD(n, 8, order=1), 1.0, 0.15, (32, 64, 128)),
        (lambda n: Implicit(n, 1, newton=3, order=1), 1.0, 0.15, (16, 32, 64)),
        (
            lambda n: Implicit(n, 1, "float64", order=2, newton=3, tolerance=1e-8),
            2.0,
            0.2,
            (16, 32, 64),
        ),
    ],
    ids=["xpbd", "backward-euler", "bdf2"],
)
def test_solvers_reach_their_order_of_convergence(reference, make, order, within, substeps):
    scene, truth = reference
    error = [rms(last(scene, make(n)), truth) for n in substeps]
    fitted = -np.polyfit(np.log2(substeps), np.log2(error), 1)[0]
    assert fitted == pytest.approx(order, abs=within), error


@pytest.mark.release
@pytest.mark.parametrize("substeps", [32, 64, 128])
def test_xpbd_of_order_2_has_a_fraction_of_the_error_of_order_1(reference, substeps):
    scene, truth = reference
    first, second = (rms(last(scene, XPBD(substeps, 8, order=o)), truth) for o in (1, 2))
    assert second < 0.35 * first


@pytest.mark.release
def test_free_fall_baseline_has_the_largest_error(reference):
    """The comparison itself: a sheet that only falls must land far off."""
    scene, truth = reference
    free = dataclasses.replace(scene, effects=scene.effects[:1])
    assert rms(last(free, XPBD(32, 1)), truth) > 100 * rms(last(scene, XPBD(32, 4)), truth)


@pytest.mark.nightly
def test_solvers_agree_on_membrane_and_dihedral_bending():
    scene = swinging((Membrane(), Dihedral()))
    truth = last(scene, Verlet(substeps=512, contact_updates=1), 2)
    moved = rms(truth, scene.assembly.rest)
    for solver in (XPBD(64, 4), Implicit(32, 1, order=2, newton=2)):
        assert rms(last(scene, solver, 2), truth) < 0.02 * moved, solver


@pytest.mark.release
def test_implicit_gradients_match_finite_differences():
    scene = swinging()
    solver = Implicit(8, 1, order=2, newton=2, tolerance=1e-6)
    system = make_system(scene, solver)
    body = scene.assembly.body
    heads = body.joint_positions(jnp.asarray(scene.assembly.rest_body, jnp.float32))[0]
    pose = jnp.repeat(body.a_pose()[None, None], 3, axis=0)
    root = jnp.repeat(heads[:1][None], 3, axis=0)
    x = jnp.asarray(scene.assembly.rest.astype(np.float32))[:, :, None]

    def height(lift):
        v = jnp.zeros_like(x).at[:, 1].set(lift)
        state = State(x, v, solver.init_state(v, 1 / (30.0 * 8)))
        _, moved, _ = advance(system, state, pose, root, solver=solver, fps=30.0)
        return moved[-1, :, 1].mean()

    slope = float(jax.grad(height)(jnp.float32(0.2)))
    step = 2e-2
    ends = [float(height(jnp.float32(0.2 + s))) for s in (step, -step)]
    assert slope == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=0.02)


@pytest.mark.release
def test_solver_at_rate_makes_cloth_independent_of_the_frame_rate():
    scene, draft = swinging(), XPBD(8, 2)
    assert draft.at_rate(30.0) == draft and draft.at_rate(240.0) == XPBD(4, 1)
    often = settle_on_static_body(scene, 6, solver=draft).positions[0]
    for solver, same in ((draft.at_rate(10.0), True), (draft, False)):
        seldom = settle_on_static_body(scene, 2, solver=solver, fps=10.0).positions[0]
        assert (np.abs(seldom - often[2::3]).max() < 1e-5) == same


@pytest.mark.release
@pytest.mark.parametrize("order", [1, 2])
def test_implicit_steps_of_one_second_are_finite(order):
    scene = swinging()
    out = settle_on_static_body(scene, 5, solver=Implicit(1, 1, order=order, newton=3), fps=1.0)
    assert out.finite.all() and np.abs(out.positions[0]).max() < 10


def test_float64_solver_does_not_change_the_global_precision():
    last(swinging(), XPBD(4, 1, "float64"), 1)
    assert jnp.zeros(2).dtype == jnp.float32


def test_invalid_solver_settings_are_refused():
    for wrong in (
        lambda: XPBD(10, 4),
        lambda: XPBD(8, 2, "float16"),
        lambda: Implicit(8, 1, order=3),
        lambda: Implicit(8, 1, newton=0),
    ):
        with pytest.raises(ValueError, match=r"substeps|precision|order|newton"):
            wrong()
    with pytest.raises(SimulationError, match="accuracy"):
        simulate(Scene((square_sheet(3),)), load_motion("balance", fps=30.0), accuracy="best")
    assert PRESETS["draft"].substeps < PRESETS["fine"].substeps


def test_status_reports_frame_and_vertex_of_non_finite_values():
    g = square_sheet(4, 0.3)
    scene = prepare_scene(Scene((g,), (Gravity(), Stretch())))
    x = np.asarray(g.mesh.vertices).copy()
    x[5] = np.nan
    out = settle_on_static_body(scene, 2, solver=XPBD(4, 1), start=x)
    assert (out.status & Status.NONFINITE).all()
    with pytest.raises(SimulationError, match="frame 0, vertex"):
        out.check()
    fine = settle_on_static_body(scene, 2, solver=XPBD(4, 1))
    assert not fine.status.any()
    fine.check()


@pytest.mark.nightly
def test_energies_are_optional_and_conserved():
    scene = swinging()
    out = settle_on_static_body(scene, 10, solver=Verlet(512, 1), energies=True)
    d = out.diagnostics
    mass = scene.assembly.mass
    free = ~scene.assembly.pinned
    height = (out.positions[0][:, free, 1] - scene.assembly.rest[free, 1]) @ mass[free]
    total = d["energy_kinetic"] + d["energy_stretch"] + d["energy_bend"] + 9.81 * height
    assert np.ptp(total) < 0.01 * d["energy_kinetic"].max()
    plain = settle_on_static_body(scene, 1, solver=XPBD(4, 1)).diagnostics
    assert not any(k.startswith("energy") for k in plain)


@pytree
@dataclasses.dataclass(frozen=True)
class _Stored(Prepared):
    elastic = True

    def energy(self, displacement, context):
        return jnp.sum(displacement**2, axis=(0, 1))


@dataclasses.dataclass(frozen=True)
class _Storing(Effect):
    def prepare(self, assembly, inverse_mass):
        return _Stored()


def test_energies_without_what_a_solver_needs_of_them_are_refused():
    scene = swinging((_Storing(),))
    with pytest.raises(SimulationError, match=r"Stored stores energy .* `hessian`"):
        make_system(scene, Implicit(4, 2))
