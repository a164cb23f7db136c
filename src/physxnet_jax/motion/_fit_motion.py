"""Fitting of skeleton motion to an animated surface."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from ..body import NUM_BODY_VERTICES, Body
from ..errors import MotionError
from ._motion import Motion, make_motion
from ._retarget import continuous

# Least sum of squared skinning weights for a joint to be fitted; below it, the joint follows
# its parent.
_MIN_WEIGHT = 12.0


def fit_motion(
    body: Body,
    surface: Float[np.ndarray, "frames vertices 3"],
    sure: Bool[np.ndarray, " vertices"],
    fps: float,
    *,
    name: str = "surface",
) -> Motion:
    """Fits joint rotations that bring the skinned body nearest to an animated surface.

    Joints are fitted from the hips outwards. Each takes the rotation that brings the
    vertices skinned to it nearest to the surface in the least-squares sense (closed form).
    Deformation that skinning can't reproduce is not represented.

    Args:
        body: The body, with the surface's proportions.
        surface: Positions of its vertices [m], shape [frames, 13380, 3].
        sure: Whether each vertex is used, shape [13380].
        fps: Frames per second.
        name: Name of the motion.

    Returns:
        The motion.

    Raises:
        MotionError: Too few of the used vertices are skinned to the hips.

    References:
        Kabsch, A solution for the best rotation to relate two sets of vectors (1976).
    """
    rest = np.asarray(body.rest_vertices(body.default_shape()), np.float64)
    heads = np.asarray(body.joint_positions(jnp.asarray(rest, jnp.float32))[0], np.float64)
    # Squared, so that vertices shared by two joints count little for either.
    share = np.where(sure[:, None], np.asarray(body.weights)[:NUM_BODY_VERTICES] ** 2, 0.0)
    frames = len(surface)
    world = np.zeros((frames, len(body.parents), 3, 3))
    at = np.zeros((frames, len(body.parents), 3))
    for j, parent in enumerate(body.parents):
        rows = np.flatnonzero(share[:, j] > 1e-3)
        weight = share[rows, j].astype(np.float64)
        known = weight.sum() >= _MIN_WEIGHT
        x, y = rest[rows], surface[:, rows].astype(np.float64)
        if parent < 0:
            if not known:
                raise MotionError(f"{name}: too few vertices are skinned to the hips.")
            weight /= weight.sum()
            middle, moved = weight @ x, np.einsum("v,fvc->fc", weight, y)
            world[:, j] = _best_turn(weight, x - middle, y - moved[:, None])
            at[:, j] = moved + world[:, j] @ (heads[j] - middle)
            continue
        at[:, j] = at[:, parent] + world[:, parent] @ (heads[j] - heads[parent])
        world[:, j] = world[:, parent]
        if known:
            world[:, j] = _best_turn(weight, x - heads[j], y - at[:, j, None])
    local = world.copy()
    for j, parent in enumerate(body.parents):
        if parent >= 0:
            local[:, j] = np.swapaxes(world[:, parent], 1, 2) @ world[:, j]
    turns = Rotation.from_matrix(local.reshape(-1, 3, 3)).as_quat(scalar_first=True)
    return make_motion(continuous(turns.reshape(frames, -1, 4)), at[:, 0], fps, name=name)


def _best_turn(
    weight: Float[np.ndarray, " rows"],
    x: Float[np.ndarray, "rows 3"],
    y: Float[np.ndarray, "frames rows 3"],
) -> Float[np.ndarray, "frames 3 3"]:
    """Rotations R that bring R x nearest to y, by weighted least squares."""
    covariance = np.einsum("v,fva,vb->fab", weight, y, x, optimize=True)
    u, _, v = np.linalg.svd(covariance)
    sign = np.sign(np.linalg.det(u @ v))
    u[:, :, 2] *= np.where(sign == 0, 1.0, sign)[:, None]
    return u @ v
