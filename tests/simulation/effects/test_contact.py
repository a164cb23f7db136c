"""Contact: the closest skin is found, cloth slides, nothing tunnels or is shot away."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physxnet_jax.body import NUM_BODY_VERTICES
from physxnet_jax.garment import free_garment, square_sheet, template
from physxnet_jax.geometry import closest_points, mesh_edges, vertex_normals
from physxnet_jax.motion import Motion, animate, load_motion
from physxnet_jax.simulation import (
    STANDARD,
    XPBD,
    Clock,
    PosedPoints,
    Scene,
    _static_body,
    prepare_scene,
    settle_on_static_body,
    simulate,
)
from physxnet_jax.simulation._effect import Step
from physxnet_jax.simulation.effects import BodyContact, Gravity, Pin, Stretch, _contact

FPS = 30.0
CLOCK = Clock(jnp.float32(0.0), 1 / 120)


def skin_at(body, rest, motion, frame):
    part = Motion(motion.rotations[frame : frame + 1], motion.root[frame : frame + 1], FPS)
    every = jnp.arange(NUM_BODY_VERTICES)
    return animate(body, rest, rest[every], body.weights[every], part)[0]


@pytest.mark.release
@pytest.mark.parametrize("name", ["top", "bottom", "dress"])
def test_closest_skin_point_matches_brute_force(body, rest, name):
    """Against brute force in the rest pose; misses are counted, and shallow."""
    scene = prepare_scene(Scene((template(name),), (BodyContact(),)))
    contact = scene.effects[0]
    x = jnp.asarray(scene.assembly.rest.astype(np.float32))
    skin = contact.skinned_points
    placed = dataclasses.replace(
        _placed(skin), points=skin.rest[:, :, None], normals=skin.normals[:, :, None]
    )
    begin = jax.jit(lambda x, at: contact.begin(x, at, at, CLOCK, contact.init_state(1)))
    context = begin(x[:, :, None], placed)
    mine = np.linalg.norm(np.asarray(context.surface.where)[: len(x), :, 0], axis=1)
    mesh = body.mesh(rest[:NUM_BODY_VERTICES])
    exact = np.sqrt(np.asarray(closest_points(mesh, x).squared_distance))
    assert (mine > exact - 1e-5).all(), "nothing is closer than the closest"
    missed = mine > exact + 1e-4
    # Sleeves keep to the arm where the trunk is a little nearer.
    assert missed.mean() < 0.02, missed.mean()


def _placed(skinned):
    from physxnet_jax.simulation._effect import PosedPoints

    return PosedPoints(skinned.rest[:, :, None], skinned.normals[:, :, None])


def fast(motion, factor):
    """The same poses in a fraction of the time: every so-manieth frame."""
    return dataclasses.replace(
        motion, rotations=motion.rotations[::factor], root=motion.root[::factor]
    )


@pytest.mark.release
def test_contact_prevents_tunnelling_in_a_punch_at_eight_times_speed():
    motion = fast(load_motion("punch", fps=FPS), 8)
    out = simulate(Scene((template("top"),)), motion)
    assert out.diagnostics["penetration_max"].max() < 2e-3
    assert out.diagnostics["inside_share"].max() < 1e-3
    # The control: without contact the sleeve stays behind.
    none = tuple(e for e in STANDARD if not isinstance(e, BodyContact))
    free = simulate(Scene((template("top"),), none), motion)
    assert "penetration_max" not in free.diagnostics
    assert np.abs(free.positions[0] - out.positions[0]).max() > 0.05


@pytest.mark.release
def test_cloth_that_starts_inside_leaves_at_bounded_speed(body, rest):
    """10 mm inside: out within a frame, no faster than the cap allows."""
    g = template("bottom")
    scene = prepare_scene(Scene((g,), (BodyContact(), Pin())))
    sunk = below_skin(body, rest, scene.assembly.rest, 0.010)
    out = settle_on_static_body(scene, 5, solver=XPBD(32, 4), start=sunk)
    d = out.diagnostics
    assert d["penetration_max"][0] < 1e-3
    # Set down, not shot away: at the cap, a metre a second, at most a few cm travelled.
    assert d["speed_max"][1:].max() < 1.5
    reckless = prepare_scene(Scene((g,), (BodyContact(leave=1e6), Pin())))
    wild = settle_on_static_body(reckless, 5, solver=XPBD(32, 4), start=sunk)
    assert wild.diagnostics["speed_max"][0] > 3.0


@pytest.mark.release
def test_cloth_deep_in_an_arm_comes_out_on_its_own_side(body, rest, monkeypatch):
    """As fast motion may leave it: beyond the middle, where the other side is nearer."""
    scene = prepare_scene(Scene((template("top"),)))
    x = scene.assembly.rest
    ends = mesh_edges(scene.assembly.faces).vertices
    length = np.linalg.norm(x[ends[:, 0]] - x[ends[:, 1]], axis=1)
    monkeypatch.setattr(_static_body, "_out_of_body", lambda _, start: start)

    def strain():
        start = below_skin(body, rest, x, 0.050)
        out = settle_on_static_body(scene, 10, solver=XPBD(32, 4), start=start).positions[0][-1]
        return np.abs(np.linalg.norm(out[ends[:, 0]] - out[ends[:, 1]], axis=1) / length - 1).max()

    assert strain() < 0.5
    # The control: the nearest skin, whichever side it is.
    jax.clear_caches()
    monkeypatch.setattr(_contact._Contact, "raised", lambda _, points, *__: points)
    assert strain() > 2.0
    jax.clear_caches()


@pytest.mark.parametrize("bad", [False, True])
def test_a_start_deep_in_the_body_is_taken_out_with_what_is_around(bad):
    """Half of a top deep in it, the other half 5 mm off; a start outside it stays as it is."""
    scene = prepare_scene(Scene((template("top"),)))
    x = scene.assembly.rest
    start = x + 0.005 * np.sign(x[:, :1])
    if bad:
        low = x[:, 1] < np.median(x[:, 1])
        start[low] -= [0.0, 0.0, 0.1] * np.sign(x[low, 2:])
    out = _static_body._out_of_body(scene.assembly, start)
    kept = (out == start).all(axis=1)
    if not bad:
        assert kept.all()
        return
    assert 0.3 < kept.mean() < 0.8 and not kept[low].all()
    np.testing.assert_array_equal(out[~kept], x[~kept])
    ends = mesh_edges(scene.assembly.faces).vertices
    mixed = ends[kept[ends].any(axis=1) & ~kept[ends].all(axis=1)]
    rest, length = (np.linalg.norm(p[mixed[:, 0]] - p[mixed[:, 1]], axis=1) for p in (x, out))
    assert len(mixed) and np.abs(length / rest - 1).max() <= 0.5


def below_skin(body, rest, x, depth):
    """Points at a depth below the skin that is closest to them [m]."""
    mesh = body.mesh(rest[:NUM_BODY_VERTICES])
    hit = closest_points(mesh, jnp.asarray(x, jnp.float32))
    tri = np.asarray(mesh.faces)[np.asarray(hit.face)]
    foot = np.einsum("vk,vkc->vc", np.asarray(hit.weights), np.asarray(mesh.vertices)[tri])
    away = (x - foot) / np.linalg.norm(x - foot, axis=1, keepdims=True)
    return foot - depth * away


@pytest.mark.release
def test_cloth_follows_its_own_limb_across_a_sharp_fold(body, rest):
    """A knee bent by 150 degrees: thigh and calf pass through each other, each keeps
    its own cloth, and the cloth comes back when the leg is stretched again."""
    frames = 24
    angle = np.radians(150) * np.sin(np.pi * np.arange(frames) / (frames - 1))
    pose = np.repeat(np.asarray(body.a_pose())[None], frames, axis=0)
    joint = body.joint("LeftLeg")
    pose[:, joint] = np.column_stack([np.cos(angle / 2), np.sin(angle / 2), 0 * angle, 0 * angle])
    heads = body.joint_positions(rest)[0]
    root = np.repeat(np.asarray(heads)[:1], frames, axis=0)
    motion = Motion(jnp.asarray(pose, jnp.float32), jnp.asarray(root), FPS, "knee")
    out = simulate(Scene((template("bottom"),)), motion)
    assert out.diagnostics["inside_share"].max() < 1e-3
    assert out.diagnostics["strain_p99"].max() < 0.5
    calm = simulate(
        Scene((template("bottom"),)),
        dataclasses.replace(motion, rotations=motion.rotations[:1], root=motion.root[:1]),
    )
    gap = np.linalg.norm(out.positions[0][-1] - calm.positions[0][0], axis=1)
    assert np.median(gap) < 0.01


@pytest.mark.release
def test_pinched_cloth_lies_between_overlapping_limbs(body, rest):
    """An arm pressed into the trunk: the cloth of both lies in the middle of the overlap."""
    scene = prepare_scene(Scene((template("top"),), (BodyContact(),)))
    contact = scene.effects[0]
    pinch = contact.pinch
    calm = pinch.room(_placed(contact.skinned_points))[:, 0]
    # The control: with the arms away from the body nothing is pinched.
    assert calm.min() > 0.0
    pose = np.asarray(body.a_pose()).copy()
    joint = body.joint("LeftArm")
    # 60 degrees about the forward axis: from the A-pose well into the flank.
    for angle in (60.0, -60.0):
        half = np.radians(angle) / 2
        turned = pose.copy()
        turned[joint] = [np.cos(half), 0.0, 0.0, np.sin(half)]
        heads = body.joint_positions(rest)[0]
        motion = Motion(jnp.asarray(turned[None], jnp.float32), heads[:1], FPS, "pressed")
        skin = contact.skinned_points
        points = animate(body, rest, skin.rest, skin.weights, motion)[0]
        along = animate(body, rest, skin.rest + 1e-3 * skin.normals, skin.weights, motion)[0]
        normals = 1e3 * (along - points)
        placed = dataclasses.replace(
            _placed(skin), points=points[..., None], normals=normals[..., None]
        )
        room = pinch.room(placed)[:, 0]
        if room.min() < -0.02:
            break
    else:
        pytest.fail("the arm wasn't pressed into the trunk either way")
    # A kilometre away the same skin has the same room, to what float32 tells there.
    for away in (8.0, 992.0):
        far = dataclasses.replace(placed, points=placed.points + jnp.float32(away))
        back = dataclasses.replace(far, points=far.points - jnp.float32(away))
        there, here = (pinch.room(x)[:, 0] for x in (far, back))
        # Where two samples are equally near either may be taken.
        assert (np.abs(there - here) > 1e-4).mean() < 1e-2
    out = simulate(
        Scene((template("top"),)),
        Motion(jnp.repeat(motion.rotations, 4, 0), jnp.repeat(motion.root, 4, 0), FPS, "held"),
    )
    assert (out.diagnostics["pinched"] > 10).all()
    assert out.diagnostics["strain_p99"].max() < 0.5


@pytest.mark.release
@pytest.mark.parametrize("push", [1e-3, 1.0])
def test_contact_corrections_are_bounded_by_the_push_setting(push):
    """Trousers 12 mm in the skin, one substep."""
    g = template("bottom")
    (contact,) = prepare_scene(Scene((g,), (BodyContact(push=push, sample_spacing=1.0),))).effects
    x = g.mesh.vertices - 0.012 * vertex_normals(g.mesh.vertices, g.mesh.faces)
    skin = PosedPoints(contact.skin.rest[:, :, None], contact.skin.normals[:, :, None])
    begun = contact.begin(
        x[:, :, None], skin, skin, Clock(jnp.float32(0.0), 0.01), contact.init_state(1)
    )
    still = jnp.zeros((len(x), 3, 1))
    moved = contact.project(still, still, begun, jnp.float32(1.0), Step(0.001, 1.0))
    far = np.linalg.norm(np.asarray(moved)[..., 0], axis=1).max()
    assert far == pytest.approx(push, rel=1e-3) if push < 0.01 else 0.005 < far < 0.03


@pytest.mark.release
def test_cloth_moving_with_the_skin_has_no_friction():
    """Trousers 2 mm too deep on skin that moves sideways by a centimetre, as they do."""
    g = template("bottom")
    # Without samples, whose normals differ from the vertices'.
    (contact,) = prepare_scene(Scene((g,), (BodyContact(sample_spacing=1.0),))).effects
    x = g.mesh.vertices - 0.004 * vertex_normals(g.mesh.vertices, g.mesh.faces)
    way = jnp.asarray([0.006, 0.0, 0.008], jnp.float32)[None, :, None]
    points, normals = contact.skin.rest[:, :, None], contact.skin.normals[:, :, None]
    before, after = PosedPoints(points, normals), PosedPoints(points + way, normals)
    clock = Clock(jnp.float32(0.0), 0.01)
    begun = contact.begin(x[:, :, None], before, after, clock, contact.init_state(1))
    still = jnp.zeros((len(x), 3, 1))
    unit = begun.unit[: len(x)]
    for moved, rubs in ((still + way, False), (still, True)):
        gap = contact.project(moved, still, begun, jnp.float32(1.0), Step(0.01, 1.0)) - moved
        along = gap - jnp.sum(gap * unit, axis=1, keepdims=True) * unit
        assert float(jnp.abs(gap).max()) > 1e-3
        assert (float(jnp.abs(along).max()) > 1e-4) == rubs


@pytest.mark.release
def test_contact_does_not_affect_cloth_far_from_the_body():
    """No height counts as limited where nothing limits it: ten metres away, say."""
    mesh = square_sheet(4, 0.3).mesh
    sheet = free_garment(np.asarray(mesh.vertices) + [0.0, 14.0, 0.0], np.asarray(mesh.faces))
    falls = [
        settle_on_static_body(
            prepare_scene(Scene((sheet,), effects)), 8, solver=XPBD(8, 1), fps=FPS
        ).positions[0]
        for effects in ((Gravity(), Stretch()), (Gravity(), Stretch(), BodyContact()))
    ]
    assert falls[0][0, 0, 1] > 12.0 and falls[0][0, 0, 1] - falls[0][-1, 0, 1] > 0.2
    np.testing.assert_allclose(falls[0], falls[1], atol=1e-5)
