"""Joint rotations from a moving surface."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from physxnet_jax.body import clothed_vertices
from physxnet_jax.errors import MotionError
from physxnet_jax.motion import body_animation, fit_motion, load_motion


@pytest.fixture(scope="module")
def surface(body):
    punch = load_motion("punch", fps=15.0)
    return punch, np.asarray(body_animation(body, punch))


def test_fitted_motion_reproduces_the_surface(body, surface):
    _, x = surface
    again = fit_motion(body, x, clothed_vertices(body), 15.0, name="again")
    assert again.fps == 15.0 and again.name == "again"
    skinned = np.asarray(body_animation(body, again))
    gap = np.linalg.norm(skinned - x, axis=2)[:, clothed_vertices(body)]
    # Vertices between two joints pull at both: millimetres, no more.
    assert np.sqrt((gap**2).mean()) < 0.005 and np.percentile(gap, 99) < 0.02


def test_fitted_motion_is_equivariant_to_rigid_motion(body, surface):
    _, x = surface
    sure = clothed_vertices(body)
    turn = Rotation.from_euler("XYZ", [20, 130, -10], degrees=True)
    matrix = turn.as_matrix().astype(np.float32)
    a = fit_motion(body, x, sure, 15.0)
    b = fit_motion(body, x @ matrix.T + np.float32(0.5), sure, 15.0)
    np.testing.assert_allclose(b.root, np.asarray(a.root) @ matrix.T + 0.5, atol=1e-4)
    first = [
        Rotation.from_quat(np.asarray(m.rotations)[:, 0], scalar_first=True).as_matrix()
        for m in (a, b)
    ]
    np.testing.assert_allclose(first[1], matrix @ first[0], atol=1e-4)
    np.testing.assert_allclose(
        np.abs((np.asarray(a.rotations) * np.asarray(b.rotations)).sum(-1))[:, 1:], 1.0, atol=1e-4
    )


def test_unconstrained_joints_follow_their_parent(body, surface):
    _, x = surface
    arm = np.asarray(body.weights)[:13380, body.joint("LeftForeArm")] > 1e-3
    motion = fit_motion(body, x, clothed_vertices(body) & ~arm, 15.0)
    still = np.asarray(motion.rotations)[:, body.joint("LeftForeArm")]
    np.testing.assert_allclose(still, np.broadcast_to([1, 0, 0, 0], still.shape), atol=1e-6)
    assert bool(jnp.isfinite(motion.rotations).all())
    with pytest.raises(MotionError, match="hips"):
        fit_motion(body, x, np.zeros(13380, bool), 15.0)
