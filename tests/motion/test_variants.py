"""Mirrored and sped-up motions are what a mirror and a clock would show."""

import dataclasses
import itertools

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from physxnet_jax.body import NUM_BODY_VERTICES, load_body
from physxnet_jax.errors import MotionError
from physxnet_jax.motion import (
    at_speed,
    body_animation,
    exaggerated,
    extrapolate_history,
    foot_heights,
    frames_at_speed,
    load_motion,
    mirror_joints,
    mirrored,
    subdued,
    with_upper_body,
)


def skin(motion):
    return np.asarray(body_animation(load_body(), motion))[:, :NUM_BODY_VERTICES]


def test_mirrored_motion_gives_the_mirrored_skin():
    body = load_body()
    motion = load_motion("punch", fps=30.0)
    # Thumbs are bent by hand: no file of motion does it.
    bent = motion.rotations.at[:, body.joint("LThumb")].set(jnp.array([0.9211, 0.0, 0.0, -0.3894]))
    motion = dataclasses.replace(motion, rotations=bent[::9], root=motion.root[::9])
    rest = np.asarray(body.rest_vertices(body.default_shape()))[:NUM_BODY_VERTICES]
    away, pair = KDTree(rest).query(rest * [-1, 1, 1])
    assert np.quantile(away, 0.99) < 2e-3, "the body is the same on both sides"
    good = away < 2e-3
    seen = skin(mirrored(body, motion))
    want = skin(motion)[:, pair] * np.float32([-1, 1, 1])
    gap = np.linalg.norm(seen - want, axis=2)[:, good]
    assert np.quantile(gap, 0.99) < 5e-3 and gap.max() < 0.02
    # A punch with one arm: without the mirror it is another motion.
    assert np.linalg.norm(seen - skin(motion), axis=2).max() > 0.3


def test_mirroring_twice_restores_the_motion():
    body, motion = load_body(), load_motion("walk", fps=30.0)
    back = mirrored(body, mirrored(body, motion))
    np.testing.assert_allclose(back.rotations, motion.rotations, atol=1e-6)
    np.testing.assert_array_equal(back.root, motion.root)
    pair = mirror_joints(body)
    np.testing.assert_array_equal(pair[pair], np.arange(len(pair)))
    assert (pair != np.arange(len(pair))).sum() > 10
    lame = dataclasses.replace(body, joint_names=("LeftArm", *body.joint_names[1:]))
    if "RightArm" in body.joint_names:
        lame = dataclasses.replace(
            body, joint_names=tuple(n.replace("RightArm", "Stump") for n in body.joint_names)
        )
    with pytest.raises(MotionError, match="same on both sides"):
        mirror_joints(lame)


def test_double_speed_keeps_every_second_frame():
    motion = load_motion("walk", fps=30.0)
    fast = at_speed(motion, 2.0)
    np.testing.assert_allclose(fast.root, motion.root[::2], atol=1e-5)
    assert fast.fps == motion.fps
    slow = at_speed(motion, 0.5)
    np.testing.assert_allclose(slow.root[::2], motion.root, atol=1e-5)
    assert at_speed(motion, 1.0).num_frames == motion.num_frames
    assert [frames_at_speed(n, 0.8) for n in (1, 2, 5)] == [1, 2, 6]
    with pytest.raises(MotionError, match="positive"):
        at_speed(motion, 0.0)
    assert jnp.isfinite(slow.rotations).all()


def angles(motion, joint):
    """Angle of a joint from its mean rotation, frame by frame [rad]."""
    turns = Rotation.from_quat(np.roll(np.asarray(motion.rotations[:, joint]), -1, axis=1))
    return (turns.mean().inv() * turns).magnitude()


@pytest.mark.parametrize("factor", [0.5, 1.25])
def test_exaggeration_scales_joint_angles_about_their_mean(factor):
    motion = load_motion("walk", fps=30.0)
    wide = exaggerated(motion, factor)
    for name in ("LeftUpLeg", "RightForeArm"):
        joint = load_body().joint_names.index(name)
        np.testing.assert_allclose(
            angles(wide, joint), factor * angles(motion, joint), rtol=0.05, atol=0.01
        )
    np.testing.assert_array_equal(wide.root, motion.root)
    np.testing.assert_array_equal(wide.rotations[:, 0], motion.rotations[:, 0])


def test_exaggeration_by_one_is_identity_and_a_large_one_is_bounded():
    motion = load_motion("punch", fps=30.0)
    same = exaggerated(motion, 1.0)
    dots = np.abs(np.sum(np.asarray(same.rotations) * np.asarray(motion.rotations), axis=2))
    np.testing.assert_allclose(dots, 1.0, atol=1e-5)
    huge = exaggerated(motion, 50.0)
    assert np.isfinite(np.asarray(huge.rotations)).all()
    joint = load_body().joint_names.index("RightArm")
    original = Rotation.from_quat(np.roll(np.asarray(motion.rotations[:, joint]), -1, axis=1))
    turned = Rotation.from_quat(np.roll(np.asarray(huge.rotations[:, joint]), -1, axis=1))
    assert (original.mean().inv() * turned).magnitude().max() < 2.61
    with pytest.raises(MotionError, match="positive"):
        exaggerated(motion, -1.0)


@pytest.mark.parametrize("factor", [0.3, 1.0])
def test_a_subdued_person_stands_on_the_floor_and_moves_less(factor):
    motion, body = load_motion("walk", fps=30.0), load_body()
    still = subdued(body, motion, factor)
    for name in ("LeftUpLeg", "RightForeArm"):
        joint = body.joint_names.index(name)
        sizes = [
            Rotation.from_quat(np.roll(np.asarray(m.rotations[:, joint]), -1, axis=1)).magnitude()
            for m in (still, motion)
        ]
        np.testing.assert_allclose(sizes[0], factor * sizes[1], atol=1e-4)
    ways = [np.ptp(np.asarray(m.root)[:, [0, 2]], axis=0) for m in (still, motion)]
    np.testing.assert_allclose(ways[0], factor * ways[1], atol=1e-3)
    rest = body.rest_vertices(body.default_shape())
    np.testing.assert_allclose(foot_heights(body, still, rest), 0.0, atol=1e-4)
    if factor == 1.0:
        dots = np.abs(np.sum(np.asarray(still.rotations) * np.asarray(motion.rotations), axis=2))
        np.testing.assert_allclose(dots, 1.0, atol=1e-5)


def test_a_person_is_not_subdued_to_nothing_or_beyond_the_motion():
    motion = load_motion("walk", fps=30.0)
    for factor in (0.0, 1.5, float("nan")):
        with pytest.raises(MotionError, match="more than 0 and at most 1"):
            subdued(load_body(), motion, factor)


def test_with_upper_body_keeps_the_legs_and_plays_back_and_forth():
    body = load_body()
    walk, punch = load_motion("walk", fps=30.0), load_motion("punch", fps=30.0)
    short = dataclasses.replace(punch, rotations=punch.rotations[:4], root=punch.root[:4])
    mixed = with_upper_body(body, walk, short)
    assert mixed.num_frames == walk.num_frames
    np.testing.assert_array_equal(mixed.root, walk.root)
    names = list(body.joint_names)
    legs = [names.index(n) for n in ("Hips", "LHipJoint", "LeftUpLeg", "RightFoot")]
    arms = [names.index(n) for n in ("LowerBack", "Head", "LeftHand", "RightArm")]
    np.testing.assert_allclose(mixed.rotations[:, legs], walk.rotations[:, legs], atol=1e-6)
    order = [0, 1, 2, 3, 2, 1, 0, 1]
    np.testing.assert_allclose(
        mixed.rotations[:8][:, arms], np.asarray(punch.rotations)[order][:, arms], atol=1e-6
    )
    slower = dataclasses.replace(punch, fps=25.0)
    with pytest.raises(MotionError, match="resample"):
        with_upper_body(body, walk, slower)
    still = dataclasses.replace(body, joint_names=tuple(f"J{k}" for k in range(len(names))))
    with pytest.raises(MotionError, match="no spine"):
        with_upper_body(still, walk, punch)


def test_extrapolated_history_goes_on_and_calms_down():
    clip = load_motion("walk", fps=60.0)
    q, p = extrapolate_history(clip.rotations, clip.root, 5, 60.0)
    assert q.shape == (5, 31, 4) and p.shape == (5, 3)
    # The root at one speed from the oldest of them to the clip's second pose.
    way = np.concatenate([p, clip.root[:2]])
    np.testing.assert_allclose(np.diff(way, n=2, axis=0), 0.0, atol=1e-6)
    assert np.abs(np.diff(way, axis=0)).max() > 0.01
    turns = [
        Rotation.from_quat(np.asarray(x), scalar_first=True) for x in (*q, *clip.rotations[:2])
    ]
    steps = [(a.inv() * b).as_matrix() for a, b in itertools.pairwise(turns)]
    np.testing.assert_allclose(steps[-2], steps[-1], atol=1e-5)
    assert np.abs(steps[-1] - np.eye(3)).max() > 0.01
    turned = Rotation.from_matrix(np.reshape(steps, (-1, 3, 3))).magnitude().reshape(6, -1)
    swings = turned[-1] > 0.01
    decay = np.exp(-((np.arange(4, -1, -1) / 9.0) ** 2))[:, None]
    np.testing.assert_allclose(
        turned[:-1, swings] / turned[-1, swings], decay + 0.0 * turned[:-1, swings], rtol=2e-2
    )
    one = extrapolate_history(clip.rotations[:1], clip.root[:1], 3, 60.0)
    np.testing.assert_allclose(one[1], np.tile(clip.root[:1], (3, 1)), atol=1e-6)
    assert np.abs(np.abs(np.sum(np.asarray(one[0] * clip.rotations[:1]), axis=-1)) - 1).max() < 1e-5
    assert extrapolate_history(clip.rotations, clip.root, 0, 60.0)[0].shape == (0, 31, 4)
    spoiled = extrapolate_history(clip.rotations.at[1].set(np.nan), clip.root, 5, 60.0)
    assert np.isfinite(np.asarray(spoiled[0])).all() and np.isfinite(np.asarray(spoiled[1])).all()


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_history_is_the_same_turn_at_every_rate(sign):
    """A joint at 4 rad/s came from sqrt(pi) / 2 * 0.15 s of turning, whatever the frame rate."""
    turned = {}
    for fps in (30.0, 120.0):
        angle = 0.5 + 4.0 * np.arange(2) / fps
        q = np.stack([np.cos(angle / 2), np.sin(angle / 2), 0 * angle, 0 * angle], -1)[:, None]
        q[1] *= sign  # the same pose
        back = extrapolate_history(
            q.astype(np.float32), np.zeros((2, 3), np.float32), int(fps), fps
        )
        was = Rotation.from_quat(np.asarray(back[0][:, 0]), scalar_first=True).as_rotvec()[:, 0]
        assert (np.diff(was) >= 0.0).all() and np.diff(was)[-1] > 0.0
        # The first step is whole, those before it fade: half of sqrt(pi) times 0.15 s of turning.
        assert abs(0.5 - was[0] - 4.0 * (0.1329 + 0.5 / fps)) < 0.01
        turned[fps] = 0.5 - was[-int(fps // 30) :: -int(fps // 30)]
    np.testing.assert_allclose(
        turned[30.0], turned[120.0], atol=4.0 * 0.5 * (1 / 30 - 1 / 120) + 0.01
    )
