"""The simulator in closed form: free fall, pendulum, stillness, order, absent effects."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physxnet_jax.body import load_body
from physxnet_jax.errors import SimulationError
from physxnet_jax.garment import free_garment, square_sheet, template
from physxnet_jax.geometry import mesh_edges
from physxnet_jax.motion import load_motion
from physxnet_jax.simulation import (
    XPBD,
    Implicit,
    Scene,
    State,
    _rollout,
    advance,
    make_system,
    prepare_scene,
    settle_on_static_body,
    simulate,
    simulate_batch,
    warmup,
)
from physxnet_jax.simulation._effect import Step
from physxnet_jax.simulation.effects import Bend, BodyContact, Damping, Gravity, Pin, Stretch

FPS = 30.0


def sheet(n=6, size=0.3, pinned=None):
    return square_sheet(n, size, pinned=pinned)


def still(frames):
    """The body's rest pose, frame after frame."""
    body = load_body()
    rest = body.rest_vertices(body.default_shape())
    pose = jnp.repeat(body.a_pose()[None, None], frames + 1, axis=0)
    root = jnp.repeat(body.joint_positions(rest)[0][:1][None], frames + 1, axis=0)
    return pose, root


def roll(garment, effects, frames, solver=None, start=None, shift=(0.0, 0.0, 0.0)):
    """Positions of every frame, with the body standing still, and diagnostics."""
    scene = prepare_scene(Scene((garment,), effects))
    start = None if start is None else np.asarray(start)
    out = settle_on_static_body(
        scene, frames, solver=solver or XPBD(16, 2), start=start, shift=shift
    )
    return out.positions[0], out.diagnostics


@pytest.mark.parametrize(("order", "farther"), [(1, 1 / 2), (2, 3 / 22)])
def test_free_fall_matches_its_closed_form(order, farther):
    g = sheet()
    moved, info = roll(g, (Gravity(), Stretch(), Bend()), 15, XPBD(32, 4, order=order))
    t = 15 / FPS
    fallen = np.asarray(g.mesh.vertices)[:, 1] - moved[-1, :, 1]
    # Farther than the parabola by a share of g h t: 1/2 for symplectic Euler, 0 for pure BDF2.
    exact = 0.5 * 9.81 * t**2 + farther * 9.81 * t / (FPS * 32)
    np.testing.assert_allclose(fallen, exact, rtol=1e-4)
    assert info["finite"].all() and info["speed_max"][-1] == pytest.approx(9.81 * t, rel=1e-4)


def test_sheet_at_rest_stays_at_rest_without_gravity():
    g = sheet()
    moved, _ = roll(g, (Stretch(), Bend()), 3)
    assert np.abs(moved[-1] - np.asarray(g.mesh.vertices)).max() < 1e-6


def test_pinned_sheet_swings_like_a_pendulum_with_bounded_strain():
    n = 6
    g = sheet(n, pinned=np.arange(n))
    moved, info = roll(g, (Gravity(), Stretch(), Bend(), Pin()), 45, XPBD(64, 2))
    np.testing.assert_allclose(moved[-1][:n], np.asarray(g.mesh.vertices)[:n], atol=1e-6)
    assert info["strain_max"].max() < 0.05
    # A uniform rod of length L falls to the vertical in 1.854 sqrt(2 L / 3 g) from level.
    quarter = 1.8541 * np.sqrt(2 * 0.3 / (3 * 9.81))
    angle = np.arctan2(moved[:, -n:, 2].mean(1) - 1.5, -moved[:, -n:, 1].mean(1))
    crossing = np.argmax(angle < 0) / FPS
    assert crossing == pytest.approx(quarter, rel=0.12)


def test_speed_and_strain_are_bounded_from_a_stretched_start():
    g = sheet()
    start = jnp.asarray(np.asarray(g.mesh.vertices)) * jnp.array([[1.2, 1.0, 1.0]])
    _, info = roll(g, (Stretch(), Bend()), 30, start=start)
    speed = info["speed_max"]
    assert np.isfinite(speed).all() and speed.max() < 30
    assert info["strain_max"][-1] < 0.3


@pytest.mark.nightly
def test_halving_the_step_halves_the_error():
    g = sheet(5, pinned=np.arange(5))
    effects = (Gravity(), Stretch(), Bend(), Pin())
    # The differences of successive refinements fall by two for a first-order method.
    runs = [roll(g, effects, 4, XPBD(n, 1, order=1))[0][-1] for n in (32, 64, 128, 256)]
    gaps = [np.sqrt(np.mean((a - b) ** 2)) for a, b in zip(runs, runs[1:])]
    orders = np.log2(np.asarray(gaps[:-1]) / np.asarray(gaps[1:]))
    assert orders.mean() == pytest.approx(1.0, abs=0.35), orders


@pytest.mark.release
def test_small_steps_do_not_lose_accuracy_to_float32():
    """The textbook form gets worse beyond 128 substeps; the compensated one does not."""
    g = sheet(5, pinned=np.arange(5))
    effects = (Gravity(), Stretch(), Bend(), Pin())
    runs = {n: roll(g, effects, 4, XPBD(n, 8))[0][-1] for n in (128, 256, 512, 1024)}
    error = {n: np.sqrt(np.mean((runs[n] - runs[1024]) ** 2)) for n in (128, 256, 512)}
    assert error[256] <= 1.05 * error[128] and error[512] <= 1.05 * error[256]


def test_translation_changes_the_result_only_by_rounding():
    g = sheet(5)
    effects = (Gravity(), Stretch(), Bend())
    here = roll(g, effects, 10)[0][-1]
    shift = (100.0, 0.0, -50.0)
    there = roll(g, effects, 10, shift=shift)[0][-1] - np.asarray(shift)
    assert np.abs(here - there).max() < 4 * np.spacing(np.float32(100.0)) * 10


@pytest.mark.parametrize("effect", [Stretch(), Bend(), Gravity(), Damping(), Pin()])
def test_absent_effects_are_not_in_the_program(effect):
    """Neither body nor effect is in the program of a scene that doesn't call for them."""
    g = sheet(4, pinned=np.arange(4))
    scene = prepare_scene(Scene((g,), (effect,)))
    pose, root = still(1)
    x = jnp.asarray(scene.assembly.rest.astype(np.float32))[:, :, None]

    def program(effects):
        system = dataclasses.replace(make_system(scene, XPBD()), effects=effects)
        return str(
            jax.make_jaxpr(lambda s: advance(system, s, pose, root, solver=XPBD(4, 1), fps=FPS))(
                State(x, jnp.zeros_like(x))
            )
        )

    with_it, without = program(scene.effects), program(())
    assert len(with_it) > len(without)
    assert "gather" not in without and "scatter" not in without
    if not isinstance(effect, Pin):
        assert "einsum" not in with_it and "dot_general" not in with_it, "the body was skinned"


@pytest.mark.release
def test_contact_without_collisions_is_bitwise_neutral():
    """The sheet falls half a metre in front of the body: contact must not be felt."""
    g = sheet(4)
    plain = roll(g, (Gravity(), Stretch(), Bend()), 5)[0]
    contact = roll(g, (Gravity(), Stretch(), Bend(), BodyContact()), 5)[0]
    np.testing.assert_array_equal(plain, contact)


@pytest.mark.nightly
def test_cloth_stays_on_the_shoulders_only_with_contact():
    g = template("top")
    motion = load_motion("stretch", fps=FPS)
    short = dataclasses.replace(motion, rotations=motion.rotations[:10], root=motion.root[:10])
    worn = simulate(Scene((g,)), short)
    assert worn.finite.all()
    assert worn.diagnostics["inside_share"].max() < 0.02
    assert worn.diagnostics["speed_max"].max() < 12.0
    fallen = simulate(Scene((g,), (Gravity(), Stretch(), Bend())), short)
    assert worn.positions[0][-1, :, 1].mean() - fallen.positions[0][-1, :, 1].mean() > 0.5


@pytest.mark.nightly
def test_batched_rollouts_match_single_rollouts():
    from physxnet_jax.simulation import simulate_batch

    g = template("bottom")
    a, b = load_motion("walk", fps=FPS), load_motion("spin", fps=FPS)
    cut = [
        dataclasses.replace(m, rotations=m.rotations[:n], root=m.root[:n])
        for m, n in ((a, 6), (b, 4))
    ]
    scene = prepare_scene(Scene((g,)))
    solver = XPBD(8, 1)
    both = simulate_batch(scene, cut, solver=solver)
    for one, m in zip(both, cut):
        alone = simulate_batch(scene, [m], solver=solver)[0]
        assert one.positions[0].shape == (m.num_frames, g.num_vertices, 3)
        assert np.abs(one.positions[0] - alone.positions[0]).max() < 5e-3


@pytest.mark.release
def test_gradients_match_finite_differences():
    g = sheet(4, pinned=np.arange(4))
    scene = prepare_scene(Scene((g,), (Gravity(), Stretch(), Bend(), Pin())))
    pose, root = still(2)
    system = make_system(scene, XPBD())
    x = jnp.asarray(scene.assembly.rest.astype(np.float32))[:, :, None]

    def height(lift):
        state = State(x, jnp.zeros_like(x).at[:, 1].set(lift))
        _, moved, _ = advance(system, state, pose, root, solver=XPBD(8, 1), fps=FPS)
        return moved[-1, :, 1].mean()

    slope = jax.grad(height)(jnp.float32(0.2))
    step = 1e-2
    difference = (height(jnp.float32(0.2 + step)) - height(jnp.float32(0.2 - step))) / (2 * step)
    assert float(slope) == pytest.approx(float(difference), rel=0.02)


def test_degenerate_cloth_stays_finite():
    """Duplicate vertices, a triangle without area, an isolated vertex."""
    v = [[0, 0, 1.5], [0.1, 0, 1.5], [0, 0, 1.6], [0, 0, 1.5], [0.3, 0.3, 1.5], [0.05, 0, 1.5]]
    bad = free_garment(np.asarray(v), np.asarray([[0, 1, 2], [0, 3, 1], [0, 5, 1]]))
    moved, info = roll(bad, (Gravity(), Stretch(), Bend()), 10)
    assert info["finite"].all()
    assert np.abs(moved[-1] - np.asarray(v)).max() < 1.0
    # The negative control: a healthy triangle keeps its edges to a per cent.
    edges = mesh_edges(np.asarray([[0, 1, 2]])).vertices
    length = np.linalg.norm(moved[-1][edges[:, 0]] - moved[-1][edges[:, 1]], axis=1)
    rest = np.linalg.norm(np.asarray(v)[edges[:, 0]] - np.asarray(v)[edges[:, 1]], axis=1)
    np.testing.assert_allclose(length, rest, rtol=0.05)


def test_invalid_scenes_and_solvers_are_refused():
    with pytest.raises(SimulationError, match="needs a garment"):
        prepare_scene(Scene(()))
    with pytest.raises(SimulationError, match="twice"):
        prepare_scene(Scene((sheet(),), (Gravity(), Gravity(g=1.0))))
    with pytest.raises(ValueError, match="multiple"):
        XPBD(substeps=10, contact_updates=4)


def test_warmup_ends_at_the_first_frame_and_moves_smoothly(body):
    motion = load_motion("punch", fps=FPS)
    lead = warmup(body, motion)
    assert lead.num_frames == 45
    q = np.asarray(lead.rotations)
    dot = np.abs((q[-1] * np.asarray(motion.rotations[0])).sum(axis=1))
    np.testing.assert_allclose(dot, 1.0, atol=1e-5)
    step = 2 * np.arccos(np.clip(np.abs((q[1:] * q[:-1]).sum(axis=2)), 0, 1))
    assert np.degrees(step).max() < 15


@pytest.mark.parametrize(("order", "within"), [(1, 1e-5), (2, 5e-3)])
@pytest.mark.parametrize("rate", [0.0, 0.5, 3.0])
def test_damping_decays_velocity_exponentially(rate, order, within):
    scene = prepare_scene(Scene((square_sheet(4),), (Damping(rate),)))
    v = np.tile([0.0, 2.0, 0.0], (16, 1))
    out = settle_on_static_body(scene, 15, solver=XPBD(16, 2, order=order), velocity=v)
    wanted = 2.0 * np.exp(-rate * np.arange(1, 16) / 30.0)
    np.testing.assert_allclose(out.diagnostics["speed_max"], wanted, rtol=within)


def test_pins_follow_the_skin_in_proportion_to_time():
    """Within a block they have gone as far as time has: no jump at its start."""
    (pin,) = prepare_scene(Scene((square_sheet(4, pinned=np.arange(4)),), (Pin(),))).effects
    where, way = jnp.full((4, 3, 1), 0.5), jnp.ones((4, 3, 1))
    still = jnp.zeros((16, 3, 1))
    for share in (0.25, 1.0):
        out = np.asarray(
            pin.project(still, still, (where, way), jnp.float32(share), Step(0.01, 0.25))
        )
        np.testing.assert_allclose(out[:4], 0.5 + share, atol=1e-6)
        assert not out[4:].any()


def test_time_continues_across_blocks_of_frames(monkeypatch):
    """Wind and gusts are told the clip's time: zero is its first frame, not a block's."""
    seen = []
    real = _rollout.advance_on

    def spy(*words, **more):
        seen.append(float(more["time"]))
        return real(*words, **more)

    monkeypatch.setattr(_rollout, "advance_on", spy)
    scene = prepare_scene(Scene((square_sheet(3),), (Gravity(),)))
    simulate_batch(scene, [load_motion("balance", fps=10.0)], solver=XPBD(2, 1))
    # A second and a half leads in, of which the last frame is the clip's first.
    np.testing.assert_allclose(seen, -1.4 + np.arange(len(seen)), atol=1e-5)
    assert len(seen) > 3


def test_diagnostics_of_a_frame_refer_to_that_frame():
    """A sheet that falls from the lead-in's start on: its speed tells when it was looked at."""
    scene = prepare_scene(Scene((square_sheet(3),), (Gravity(),)))
    (out,) = simulate_batch(scene, [load_motion("balance", fps=10.0)], solver=XPBD(2, 1))
    fallen = (14 + np.arange(len(out.finite))) / 10.0
    np.testing.assert_allclose(out.diagnostics["speed_max"], 9.81 * fallen, rtol=1e-4)
    moved = np.diff(out.positions[0][:, 0, 1]) * 10.0
    np.testing.assert_allclose(-moved, 9.81 * (fallen[1:] - 0.05 + 3 / 22 / 20), rtol=1e-3)


@pytest.mark.nightly
def test_company_in_the_batch_changes_no_bit():
    """Nor company that isn't finite."""
    scene = prepare_scene(Scene((template("bottom"),)))

    def first(name):
        m = load_motion(name, fps=30.0)
        return dataclasses.replace(m, rotations=m.rotations[:5], root=m.root[:5])

    person, walker, dancer = (first(n) for n in ("punch", "walk", "spin"))
    broken = dataclasses.replace(walker, root=walker.root.at[2].set(jnp.nan))
    runs = [
        simulate_batch(scene, [person, other], solver=XPBD(8, 1))[0].positions[0]
        for other in (walker, dancer, broken)
    ]
    assert np.isfinite(runs[0]).all()
    for other in runs[1:]:
        np.testing.assert_array_equal(runs[0], other)


@pytest.mark.release
@pytest.mark.parametrize("order", [1, 2])
def test_company_changes_no_bit_of_an_implicit_step(order):
    """Company that needs more iterations of the linear solver, or never ends."""
    g = sheet(6, pinned=np.arange(4))
    scene = prepare_scene(Scene((g,), (Gravity(), Stretch(), Bend(), Pin())))
    solver = Implicit(4, 1, order=order, newton=2, iterations=200)
    system = make_system(scene, solver)
    rest = scene.assembly.rest.astype(np.float32)
    noise = np.random.default_rng(0).normal(size=rest.shape).astype(np.float32)
    body = load_body()
    pose = jnp.tile(body.a_pose()[None, None], (3, 2, 1, 1))
    root = jnp.zeros((3, 2, 3))
    ends = []
    for other in (rest, rest + 0.02 * noise, rest * 1.5, np.nan * rest):
        x = jnp.asarray(np.stack([rest + 1e-5 * noise, other], axis=2))
        state = State(x, jnp.zeros_like(x))
        _, moved, _ = advance(system, state, pose, root, solver=solver, fps=FPS)
        ends.append(np.asarray(moved)[..., 0])
    assert np.isfinite(ends[0]).all()
    for end in ends[1:]:
        np.testing.assert_array_equal(ends[0], end)
