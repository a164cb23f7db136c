"""Floor: cloth rests on a plane, slides on it with Coulomb friction, and is left alone above."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physxnet_jax.body import NUM_BODY_VERTICES
from physxnet_jax.garment import Fabric, square_sheet, tailor
from physxnet_jax.motion import Motion, load_motion
from physxnet_jax.simulation import (
    XPBD,
    Implicit,
    Scene,
    advance,
    make_system,
    needs_floor,
    prepare_scene,
    settle_on_static_body,
    start_state,
)
from physxnet_jax.simulation.effects import Bend, Floor, Gravity, Stretch

FPS = 30.0
FABRIC = Fabric(friction=0.4, thickness=0.004)


def sheet(fabric=FABRIC):
    return square_sheet(7, 0.3, fabric=fabric)


def roll(scene, solver, frames, velocity=(0.0, 0.0, 0.0), height=0.0):
    """Positions of a level sheet that starts at this height with this velocity."""
    system = make_system(scene, solver)
    x = np.array(scene.assembly.rest, np.float32)
    x[:, 1] = height
    x = jnp.asarray(x)[:, :, None]
    v = jnp.broadcast_to(jnp.asarray(velocity, jnp.float32)[None, :, None], x.shape)
    pose = jnp.broadcast_to(jnp.asarray([1.0, 0.0, 0.0, 0.0]), (frames + 1, 1, 31, 4))
    root = jnp.zeros((frames + 1, 1, 3), jnp.float32)
    state = start_state(system, x, v, solver=solver, fps=FPS)
    out = advance(system, state, pose, root, solver=solver, fps=FPS)[1]
    return np.concatenate([x[None], out])[..., 0]


@pytest.mark.release
@pytest.mark.parametrize("solver", [XPBD(32, 4), XPBD(8, 1), Implicit(16, 4)])
@pytest.mark.parametrize("height", [0.0, -0.7])
def test_falling_cloth_comes_to_rest_on_the_floor(solver, height):
    scene = prepare_scene(Scene((sheet(),), (Gravity(), Stretch(), Bend(), Floor(height))))
    out = roll(scene, solver, 30, height=height + 0.2)
    np.testing.assert_allclose(out[-1, :, 1], height + 0.002, atol=2e-4)
    assert out[..., 1].min() > height + 0.002 - 2e-4, "it never goes through"
    free = roll(prepare_scene(Scene((sheet(),), (Gravity(),))), solver, 30, height=height + 0.2)
    assert free[-1, :, 1].max() < height - 1.0


@pytest.mark.parametrize("friction", [0.2, 0.6])
def test_sliding_cloth_decelerates_by_coulombs_law(friction):
    """x(t) = v t - mu g t^2 / 2 until it stops at v^2 / (2 mu g)."""
    v = 1.5
    fabric = dataclasses.replace(FABRIC, friction=friction)
    scene = prepare_scene(Scene((sheet(fabric),), (Gravity(), Floor())))
    out = roll(scene, XPBD(128, 1), 45, (v, 0.0, 0.0), height=0.002)
    way = (out - out[:1])[..., 0].mean(axis=1)
    t = np.arange(46) / FPS
    stop = v / (friction * 9.81)
    t = np.minimum(t, stop)
    np.testing.assert_allclose(way, v * t - 0.5 * friction * 9.81 * t**2, atol=0.01)


@pytest.mark.release
def test_a_floor_out_of_reach_changes_no_bit():
    effects = (Gravity(), Stretch(), Bend())
    without = roll(prepare_scene(Scene((sheet(),), effects)), XPBD(16, 2), 6, height=1.0)
    far = roll(
        prepare_scene(Scene((sheet(),), (*effects, Floor(-9.0)))), XPBD(16, 2), 6, height=1.0
    )
    np.testing.assert_array_equal(without, far)


@pytest.mark.release
def test_gradients_through_the_landing_are_finite():
    scene = prepare_scene(Scene((sheet(),), (Gravity(), Stretch(), Floor())))
    solver = XPBD(8, 1)
    system = make_system(scene, solver)
    x = np.array(scene.assembly.rest, np.float32)
    # Exactly on the floor, and at rest: the corner of the clip and of the friction's norm.
    x[:, 1] = 0.002
    pose = jnp.broadcast_to(jnp.asarray([1.0, 0.0, 0.0, 0.0]), (5, 1, 31, 4))
    root = jnp.zeros((5, 1, 3), jnp.float32)

    def end(start):
        state = start_state(system, start, solver=solver, fps=FPS)
        return jnp.sum(advance(system, state, pose, root, solver=solver, fps=FPS)[1] ** 2)

    slope = jax.grad(end)(jnp.asarray(x)[:, :, None])
    assert np.isfinite(slope).all() and np.abs(slope).max() > 0.0


def test_depth_below_the_floor_is_reported():
    scene = prepare_scene(Scene((sheet(),), (Gravity(), Floor(0.5))))
    start = np.array(scene.assembly.rest, np.float32)
    start[:, 1] = 0.3
    held = prepare_scene(Scene((square_sheet(7, 0.3, pinned=np.arange(49)),), (Floor(0.5),)))
    moved = settle_on_static_body(scene, 2, solver=XPBD(4, 1), start=start)
    assert moved.diagnostics["below_floor_max"].max() < 1e-6
    # Vertices without mass aren't moved, nor counted.
    still = settle_on_static_body(held, 2, solver=XPBD(4, 1), start=start)
    assert still.diagnostics["below_floor_max"].max() == 0.0


@pytest.mark.release
def test_long_garments_and_low_persons_call_for_a_floor(body, rest):
    cloth = sheet()
    down = np.asarray(rest)[:NUM_BODY_VERTICES, 1].min() + 0.02
    shift = jnp.asarray([0.0, down, 0.0], cloth.offset.dtype)
    long = dataclasses.replace(cloth, offset=cloth.offset + shift[None])
    walk = load_motion("walk", fps=10.0)
    assert needs_floor((tailor("tee"), long))
    assert not needs_floor((tailor("tee"), tailor("trousers")), motion=walk)
    low = Motion(walk.rotations, walk.root - jnp.asarray([[0.0, 0.5, 0.0]]), walk.fps)
    assert needs_floor((tailor("tee"),), motion=low)
    assert not needs_floor((tailor("tee"),), motion=low, height=-0.5)
