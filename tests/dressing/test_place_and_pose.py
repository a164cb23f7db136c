"""The place where a person stands changes nothing, nor does a bad pose in another frame."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physxnet_jax.dressing import (
    Inference,
    Simulation,
    clothe,
    clothe_step,
    dress,
    init_stream,
    make_dresser,
    with_shape,
)
from physxnet_jax.errors import PhysXNetError
from physxnet_jax.motion import Motion, ground_point, load_motion, make_motion
from physxnet_jax.simulation.effects import TURBULENCE_PERIOD

NANO = Inference(weights="nano")
FRAMES = 24
FAR = np.array([1e4, 0.0, -7e3], np.float32)


@pytest.fixture(scope="module")
def motion():
    return load_motion("walk", fps=30.0)[:FRAMES]


@pytest.fixture(scope="module", params=["lbs", pytest.param("network", marks=pytest.mark.release)])
def dresser(request):
    return make_dresser(["bottom"], method=request.param, inference=NANO)


@functools.partial(jax.jit, static_argnames="fps")
def cloth_of(dresser, q, p, fps=30.0):
    return clothe(dresser, q, p, fps)


@functools.partial(jax.jit, static_argnames="fps")
def step(dresser, stream, q, p, fps=30.0):
    return clothe_step(dresser, stream, q, p, fps)


def stream_of(dresser, q, p):
    stream, frames = init_stream(dresser, q[:2], p[:2]), []
    for k in range(len(q)):
        stream, now = step(dresser, stream, q[k], p[k])
        frames.append(now)
    return jax.tree.map(lambda *x: jnp.stack(x), *frames), stream


def far_and_near(motion):
    """A motion far away, and the same rounded motion with its first frame above the origin."""
    far = motion.moved(FAR)
    place = ground_point(far)
    assert np.linalg.norm(place) > 1e4 and place[1] == 0.0
    return far, far.moved(-place), place


def check_apart(far, near, place):
    """Differs by the place, but for the spacing of float32 there."""
    away = np.asarray(far, np.float64) - place.astype(np.float64) - np.asarray(near, np.float64)
    assert np.abs(away).max() <= 0.501 * np.spacing(np.float32(np.abs(place).max()))


@pytest.mark.release
def test_ten_kilometres_away_cloth_is_the_same(dresser, motion):
    far, near, place = far_and_near(motion)
    found, expected = (cloth_of(dresser, m.rotations, m.root) for m in (far, near))
    assert found.ok.all()
    check_apart(found["bottom"], expected["bottom"], place)
    streamed, _ = stream_of(dresser, far.rotations, far.root)
    np.testing.assert_allclose(streamed["bottom"], found["bottom"], atol=1.1e-3)


@pytest.mark.sampled(2)
@pytest.mark.release
@pytest.mark.parametrize("method", ["network", "lbs", "guided", "simulate"])
def test_ten_kilometres_away_the_dressed_person_is_the_same(motion, method):
    far, near, place = far_and_near(motion)
    options = {"method": method, "inference": NANO, "simulation": Simulation(substeps=8)}
    blocks = []
    found = dress(far, ["bottom"], on_block=blocks.append, **options)
    expected = dress(near, ["bottom"], **options)
    for a, b in zip(found.meshes, expected.meshes, strict=True):
        check_apart(a.positions, b.positions, place)
    skeletons = [m.skinning for m in found.meshes if m.skinning is not None]
    assert all(np.abs(s.translations[:, 0, 0] - 1e4).max() < 5.0 for s in skeletons)
    if method == "simulate":
        check_apart(found.rollout.positions[0], expected.rollout.positions[0], place)
    else:
        seen = np.concatenate([b.positions["bottom"] for b in blocks])
        np.testing.assert_array_equal(seen, found.garments[0].positions)


def test_places_where_single_precision_is_coarse_are_noted(motion):
    for away, expected in ((5e4, ("50 km",)), (1e4, ())):
        moved = motion[:2].moved(np.array([away, 0.0, 0.0], np.float32))
        notes = dress(moved, ["bottom"], method="lbs").notes
        found = [n for n in notes if "single precision" in n]
        assert len(found) == len(expected)
        assert all(e in n and "steps of 4 mm" in n for e, n in zip(expected, found, strict=True))


@pytest.mark.release
def test_a_stream_follows_a_person_who_walks_away(dresser, motion):
    """Over the distance at which its place moves; without contact, which rounding can switch."""
    dresser = dataclasses.replace(dresser, colliders=None)
    steps = np.zeros((FRAMES, 3), np.float32)
    steps[:, 0] = np.arange(FRAMES)
    p = motion.root + steps
    streamed, stream = stream_of(dresser, motion.rotations, p)
    moved = np.asarray(stream.place - p[0])[[0, 2]] / TURBULENCE_PERIOD
    assert moved[0] > 0.9 and streamed.ok.all()
    np.testing.assert_allclose(moved, np.round(moved), atol=1e-6)
    whole = cloth_of(dresser, motion.rotations, p)["bottom"]
    np.testing.assert_allclose(streamed["bottom"], whole, atol=1e-4)


BAD = [0.0, 1e-13, 1e20, np.nan, np.inf]


@pytest.mark.release
@pytest.mark.parametrize("scale", BAD)
def test_a_bad_pose_affects_its_window_alone(dresser, motion, scale):
    at, frames = 5, np.arange(FRAMES)
    bad = motion.rotations.at[at, 3].multiply(scale)
    found = cloth_of(dresser, bad, motion.root)
    expected = ~np.isin(frames - at, dresser.seen())
    np.testing.assert_array_equal(found.ok, expected)
    clean = cloth_of(dresser, motion.rotations, motion.root)["bottom"]
    np.testing.assert_array_equal(found["bottom"][expected], clean[expected])
    assert np.isnan(found["bottom"][~expected]).all()
    streamed, _ = stream_of(dresser, bad, motion.root)
    np.testing.assert_array_equal(streamed.ok, expected)
    np.testing.assert_allclose(streamed["bottom"], found["bottom"], atol=1e-5)


@pytest.mark.sampled(4)
@pytest.mark.release
@pytest.mark.parametrize("which", ["rotations", "root", "first", "all"])
def test_a_masked_loss_has_finite_gradients_in_all_other_frames(dresser, motion, which):
    q, p = motion.rotations, motion.root
    q = {"rotations": q.at[5, 3, 1].set(jnp.nan), "all": q * jnp.nan}.get(which, q)
    p = {"root": p.at[5, 0].set(jnp.inf), "first": p.at[0, 2].set(jnp.nan)}.get(which, p)

    def loss(q, p):
        cloth = clothe(dresser, q, p, 30.0)
        each = jnp.mean(cloth["bottom"] ** 2, axis=(1, 2))
        return jnp.sum(jnp.where(cloth.ok, each, 0.0)), cloth.ok

    (dq, dp), ok = jax.jit(jax.grad(loss, (0, 1), has_aux=True))(q, p)
    assert np.isfinite(dq).all() and np.isfinite(dp).all()
    bad = np.arange(FRAMES) if which == "all" else [{"first": 0}.get(which, 5)]
    reached = [k + d for k in bad for d in dresser.seen()]
    np.testing.assert_array_equal(ok, ~np.isin(np.arange(FRAMES), reached))
    moved = np.abs(dp).max(axis=1) > 0
    assert moved[np.asarray(ok)].all()


def test_bad_quaternions_are_refused_before_the_computation(motion):
    for scale, kind in ((0.0, "zero"), (1e-13, "zero"), (1e20, "huge"), (np.nan, "not finite")):
        q = np.asarray(motion.rotations, np.float64).copy()
        q[4, 2] *= scale
        with pytest.raises(PhysXNetError, match=f"frame 4, joint 2 (has a|is) {kind}"):
            make_motion(q, motion.root, 30.0)
        broken = Motion(jnp.asarray(q, jnp.float32), motion.root, 30.0)
        with pytest.raises(PhysXNetError, match="frame 4, joint 2"):
            dress(broken, ["bottom"], method="lbs")
    # Any other length is made one.
    q = 3.0 * np.asarray(motion.rotations)
    same = make_motion(q, motion.root, 30.0)
    np.testing.assert_allclose(same.rotations, motion.rotations, atol=1e-6)


def test_shapes_beyond_their_limits_are_refused(dresser, motion):
    body = dresser.body
    q, p = motion.rotations[:1], motion.root[:1]
    well = jax.jit(lambda s: clothe(with_shape(dresser, s), q, p, 30.0).ok)
    for value in (-1.5, 2.5, np.nan, np.inf):
        shape = body.default_shape().at[1].set(value)
        for attempt in (
            lambda s: with_shape(dresser, s),
            lambda s: make_dresser(["bottom"], method="lbs", shape=s),
            lambda s: dress(motion, ["bottom"], method="lbs", shape=s),
        ):
            with pytest.raises(PhysXNetError, match=f"{body.shape_names[1]}="):
                attempt(shape)
        assert not well(shape).any()
    assert well(body.default_shape().at[1].set(0.5)).all()


def test_a_place_that_is_not_finite_is_the_origin():
    broken = dataclasses.replace(load_motion("walk", fps=30.0)[:2], root=jnp.full((2, 3), jnp.nan))
    assert not ground_point(broken).any()


@pytest.mark.release
def test_a_stream_that_begins_with_a_bad_pose_is_well_once_it_has_seen_good_ones(dresser, motion):
    q, p = motion.rotations, motion.root
    frames = max(dresser.seen(30.0)) + 2
    for first, expected in ((q[:1] * jnp.nan, False), (q[:1], True)):
        stream, found = init_stream(dresser, first, p[:1]), []
        for k in range(frames):
            stream, now = step(dresser, stream, q[k], p[k])
            found.append(bool(now.ok))
        assert found[0] == (expected or frames == 2) and found[-1]


@pytest.mark.parametrize("fps", [0.0, -30.0, np.nan, np.inf])
def test_rates_that_are_none_are_refused(fps):
    dresser = make_dresser(["bottom"], method="lbs")
    still = load_motion("walk", fps=30.0)[:1]
    stream = init_stream(dresser, still.rotations, still.root)
    for call in (
        lambda: clothe(dresser, still.rotations, still.root, fps),
        lambda: init_stream(dresser, still.rotations, still.root, fps),
        lambda: clothe_step(dresser, stream, still.rotations[0], still.root[0], fps),
    ):
        with pytest.raises(PhysXNetError, match="fps"):
            call()


@pytest.mark.release
@pytest.mark.parametrize("method", ["network", "guided"])
def test_new_streams_can_be_donated(method):
    dresser = make_dresser(["bottom"], method=method, inference=NANO)
    motion = load_motion("walk", fps=30.0)[:3]
    q, p = motion.rotations, motion.root
    given = jax.jit(clothe_step, static_argnames="fps", donate_argnames="stream")
    stream, kept = init_stream(dresser, q[:2], p[:2]), init_stream(dresser, q[:2], p[:2])
    found = given(dresser, stream, q[2], p[2], fps=30.0)[1]
    np.testing.assert_allclose(
        found["bottom"], clothe_step(dresser, kept, q[2], p[2], 30.0)[1]["bottom"], atol=1e-3
    )
