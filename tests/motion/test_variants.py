"""Mirrored and sped-up motions are what a mirror and a clock would show."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import KDTree

from physxnet_jax.body import NUM_BODY_VERTICES, load_body
from physxnet_jax.errors import MotionError
from physxnet_jax.motion import (
    at_speed,
    body_animation,
    load_motion,
    mirror_joints,
    mirrored,
)


def skin(motion):
    return np.asarray(body_animation(load_body(), motion))[:, :NUM_BODY_VERTICES]


def test_the_skin_of_a_mirrored_motion_is_the_mirrored_skin():
    body = load_body()
    motion = load_motion("punch", fps=30.0)
    motion = dataclasses.replace(motion, rotations=motion.rotations[::9], root=motion.root[::9])
    rest = np.asarray(body.rest_vertices(body.default_shape()))[:NUM_BODY_VERTICES]
    away, pair = KDTree(rest).query(rest * [-1, 1, 1])
    assert np.quantile(away, 0.99) < 2e-3, "the body is the same on both sides"
    good = away < 2e-3
    seen = skin(mirrored(body, motion))
    want = skin(motion)[:, pair] * np.float32([-1, 1, 1])
    gap = np.linalg.norm(seen - want, axis=2)[:, good]
    assert np.quantile(gap, 0.99) < 5e-3
    # A punch with one arm: without the mirror it is another motion.
    assert np.linalg.norm(seen - skin(motion), axis=2).max() > 0.3


def test_a_mirror_twice_is_no_mirror():
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


def test_twice_as_fast_is_every_second_frame():
    motion = load_motion("walk", fps=30.0)
    fast = at_speed(motion, 2.0)
    np.testing.assert_allclose(fast.root, motion.root[::2], atol=1e-5)
    assert fast.fps == motion.fps
    slow = at_speed(motion, 0.5)
    np.testing.assert_allclose(slow.root[::2], motion.root, atol=1e-5)
    assert at_speed(motion, 1.0).num_frames == motion.num_frames
    with pytest.raises(MotionError, match="positive"):
        at_speed(motion, 0.0)
    assert jnp.isfinite(slow.rotations).all()
