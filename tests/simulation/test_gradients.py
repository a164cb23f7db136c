"""Gradients through contact by material and pose, and a material found by them."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physxnet_jax.errors import SimulationError
from physxnet_jax.garment import Fabric, square_sheet
from physxnet_jax.simulation import (
    XPBD,
    Implicit,
    Scene,
    State,
    Verlet,
    advance,
    make_system,
    prepare_scene,
    start_state,
)
from physxnet_jax.simulation.effects import (
    Bend,
    BodyContact,
    Dihedral,
    Gravity,
    Membrane,
    Pin,
    Stretch,
)

FPS = 30.0
STEPS = XPBD(8, 2)


@pytest.fixture(scope="module")
def draped(rest):
    """A kerchief that lies on the head and slides as the person tilts."""
    skin = np.asarray(rest, np.float64)[:13380]
    crown = skin[skin[:, 1].argmax()]
    fabric = Fabric(stretch=200.0, bend=1e-4, friction=0.4)
    corner = tuple(float(c) for c in crown + [-0.09, 0.006, -0.09])
    g = square_sheet(5, 0.18, corner=corner, fabric=fabric)
    return prepare_scene(Scene((g,), (Gravity(), Stretch(), Bend(), BodyContact())))


def roll(scene, solver, *, tilt, frames=4, **factors):
    body = scene.assembly.body
    dtype = solver.precision
    pose = jnp.repeat(body.a_pose().astype(dtype)[None, None], frames + 1, axis=0)
    angle = tilt * jnp.linspace(0.0, 1.0, frames + 1, dtype=dtype)
    zero = jnp.zeros_like(angle)
    turn = jnp.stack([jnp.cos(angle / 2), zero, zero, jnp.sin(angle / 2)], axis=1)
    pose = pose.at[:, 0, 0].set(turn)
    heads = body.joint_positions(jnp.asarray(scene.assembly.rest_body, jnp.float32))[0]
    root = jnp.repeat(heads[:1][None].astype(dtype), frames + 1, axis=0)
    x = jnp.asarray(scene.assembly.rest.astype(dtype))[:, :, None]
    state = State(x, jnp.zeros_like(x))
    system = make_system(scene, solver).rescaled(**factors)
    _, moved, info = advance(system, state, pose, root, solver=solver, fps=FPS)
    return moved[-1, :, :, 0], info


@pytest.mark.release
def test_gradients_through_contact_match_finite_differences(draped):
    """By bending stiffness, friction and pose, in float32; differences in float64, whose
    steps are so short that no vertex changes its triangle within one."""
    at = {"bend": 1.0, "friction": 1.0, "tilt": 0.3}

    def loss(values, solver):
        x, _ = roll(draped, solver, **values)
        return jnp.mean(x[:, 0]) + 50.0 * jnp.mean((x - x.mean(axis=0, keepdims=True)) ** 2)

    slope = jax.grad(loss)({k: jnp.float32(v) for k, v in at.items()}, STEPS)
    exact = dataclasses.replace(STEPS, precision="float64")
    with jax.enable_x64(True):
        values = {k: jnp.asarray(v, "float64") for k, v in at.items()}
        for name, step in (("bend", 1e-4), ("friction", 1e-4), ("tilt", 1e-6)):
            ends = [float(loss(values | {name: values[name] + s}, exact)) for s in (step, -step)]
            difference = (ends[0] - ends[1]) / (2 * step)
            assert float(slope[name]) == pytest.approx(difference, rel=0.02), name
            assert abs(difference) > 1e-5, name


@pytest.mark.release
def test_kerchief_is_in_contact_with_the_head(draped):
    """Control: without contact the test above would test free fall."""
    x, info = roll(draped, STEPS, tilt=jnp.float32(0.3))
    assert info["inside_share"].max() < 0.05
    still, _ = roll(draped, STEPS, tilt=jnp.float32(0.0))
    assert np.abs(np.asarray(x - still)).max() > 0.02


def test_unknown_rescaling_parameters_are_refused(draped):
    with pytest.raises(SimulationError, match="bend, friction, stretch"):
        make_system(draped, STEPS).rescaled(colour=1.0)
    sheet = square_sheet(3, 0.2)
    for effects, name in (((Gravity(), Bend()), "stretch"), ((Gravity(), Stretch()), "friction")):
        system = make_system(prepare_scene(Scene((sheet,), effects)), STEPS)
        with pytest.raises(SimulationError, match=f"No effect of this scene has {name}"):
            system.rescaled(**{name: 2.0})


@pytest.mark.parametrize("factor", [-0.5, float("nan"), float("inf")])
@pytest.mark.parametrize("name", ["stretch", "bend", "friction"])
def test_invalid_rescaling_factors_are_refused(draped, name, factor):
    system = make_system(draped, STEPS)
    with pytest.raises(SimulationError, match="expected a"):
        system.rescaled(**{name: factor})
    if name == "friction":
        system.rescaled(friction=0.0)
    else:
        with pytest.raises(SimulationError, match="positive"):
            system.rescaled(**{name: jnp.float32(0.0)})


@pytest.mark.nightly
@pytest.mark.parametrize(
    "solver",
    [XPBD(8, 2), Implicit(8, 2), Implicit(8, 2, order=1), Verlet(256, 2, precision="float32")],
)
@pytest.mark.parametrize("elastic", [(Stretch(), Bend()), (Membrane(), Bend())])
def test_rescaled_scene_matches_a_scene_of_that_fabric(solver, elastic, body, rest):
    """Forces, and what a solver keeps of stiffnesses, change together."""
    pose = jnp.repeat(body.a_pose()[None, None], 5, axis=0)
    root = jnp.repeat(body.joint_positions(rest)[0][:1][None], 5, axis=0)

    def roll(fabric, **factors):
        g = square_sheet(6, 0.2, pinned=np.arange(6), fabric=fabric)
        scene = prepare_scene(Scene((g,), (Gravity(), *elastic, Pin())))
        system = make_system(scene, solver).rescaled(**factors)
        x = jnp.asarray(g.mesh.vertices)[:, :, None]
        state = start_state(system, x, solver=solver, fps=FPS)
        return np.asarray(advance(system, state, pose, root, solver=solver, fps=FPS)[1])

    soft, stiff = Fabric(stretch=200.0, bend=2e-5), Fabric(stretch=400.0, bend=2e-3)
    plain, made, told = roll(soft), roll(stiff), roll(soft, bend=100.0, stretch=2.0)
    assert np.abs(made - told).max() < 2e-5 and np.abs(made - plain).max() > 2e-3


@pytest.mark.nightly
def test_bending_stiffness_is_recovered_from_motion(body, rest):
    """Newton on its logarithm, by gradients alone: within 5 per cent of the truth."""
    fabric = Fabric(stretch=500.0, bend=2e-4)
    g = square_sheet(7, 0.2, pinned=np.arange(7), fabric=fabric)
    scene = prepare_scene(Scene((g,), (Gravity(), Stretch(), Bend(), Pin())))
    system = make_system(scene, STEPS)
    pose = jnp.repeat(body.a_pose()[None, None], 9, axis=0)
    root = jnp.repeat(body.joint_positions(rest)[0][:1][None], 9, axis=0)
    x = jnp.asarray(scene.assembly.rest.astype(np.float32))[:, :, None]

    def motion(log):
        changed = system.rescaled(bend=jnp.exp(log))
        state = State(x, jnp.zeros_like(x))
        return advance(changed, state, pose, root, solver=STEPS, fps=FPS)[1]

    truth = motion(jnp.log(jnp.float32(3.0)))
    loss = jax.jit(jax.value_and_grad(lambda log: jnp.mean((motion(log) - truth) ** 2)))
    at, step = jnp.float32(0.0), 0.5
    _, slope = loss(at)
    for _ in range(15):
        new = at - step * jnp.sign(slope)
        _, after = loss(new)
        # A change of sign brackets the minimum: halve the step.
        step = step * 0.5 if float(after * slope) < 0 else step
        at, slope = new, after
    assert float(jnp.exp(at)) == pytest.approx(3.0, rel=0.05)


@pytest.mark.release
def test_rescaled_friction_matches_a_fabric_of_that_friction(body, rest):
    """The kerchief on a head that tilts: twice the friction told is twice the friction made."""
    skin = np.asarray(rest, np.float64)[:13380]
    crown = skin[skin[:, 1].argmax()]
    corner = tuple(float(c) for c in crown + [-0.09, 0.006, -0.09])
    pose = jnp.repeat(body.a_pose()[None, None], 5, axis=0)
    angle = 0.3 * jnp.linspace(0.0, 1.0, 5)
    zero = jnp.zeros_like(angle)
    turn = jnp.stack([jnp.cos(angle / 2), zero, zero, jnp.sin(angle / 2)], axis=1)
    pose = pose.at[:, 0, 0].set(turn)
    root = jnp.repeat(body.joint_positions(rest)[0][:1][None], 5, axis=0)

    def roll(rub, **factors):
        fabric = Fabric(stretch=200.0, bend=1e-4, friction=rub)
        g = square_sheet(5, 0.18, corner=corner, fabric=fabric)
        scene = prepare_scene(Scene((g,), (Gravity(), Stretch(), Bend(), BodyContact())))
        system = make_system(scene, STEPS).rescaled(**factors)
        x = jnp.asarray(g.mesh.vertices)[:, :, None]
        state = State(x, jnp.zeros_like(x))
        return np.asarray(advance(system, state, pose, root, solver=STEPS, fps=FPS)[1])

    plain, made, told = roll(0.2), roll(0.4), roll(0.2, friction=2.0)
    assert np.abs(made - told).max() < 1e-5 and np.abs(made - plain).max() > 1e-3


@pytest.mark.release
def test_rescaled_bending_matches_dihedral_fabric(body, rest):
    pose = jnp.repeat(body.a_pose()[None, None], 5, axis=0)
    root = jnp.repeat(body.joint_positions(rest)[0][:1][None], 5, axis=0)

    def roll(fabric, **factors):
        g = square_sheet(6, 0.2, pinned=np.arange(6), fabric=fabric)
        scene = prepare_scene(Scene((g,), (Gravity(), Membrane(), Dihedral(), Pin())))
        system = make_system(scene, STEPS).rescaled(**factors)
        x = jnp.asarray(g.mesh.vertices)[:, :, None]
        state = start_state(system, x, solver=STEPS, fps=FPS)
        return np.asarray(advance(system, state, pose, root, solver=STEPS, fps=FPS)[1])

    soft = Fabric(stretch=200.0, bend=2e-5)
    stiff = dataclasses.replace(soft, stretch=400.0, bend=2e-3)
    plain, made, told = roll(soft), roll(stiff), roll(soft, bend=100.0, stretch=2.0)
    assert np.abs(made - told).max() < 2e-5 and np.abs(made - plain).max() > 2e-3
