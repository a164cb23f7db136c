"""Poses that align bones with given directions by the smallest rotations."""

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.spatial.transform import Rotation

from ._body import Body


def smallest_rotation(a: Float[np.ndarray, "3"], b: Float[np.ndarray, "3"]) -> Rotation:
    """The rotation by the smallest angle that takes direction a to direction b."""
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    axis = np.cross(a, b)
    sine, cosine = float(np.linalg.norm(axis)), float(a @ b)
    if sine < 1e-9:
        if cosine > 0:
            return Rotation.identity()
        # Opposite directions: any perpendicular axis works.
        side = np.cross(a, np.eye(3)[int(np.argmin(np.abs(a)))])
        return Rotation.from_rotvec(np.pi * side / np.linalg.norm(side))
    return Rotation.from_rotvec(axis / sine * np.arctan2(sine, cosine))


def bone_directions(
    body: Body, shape: Float[Array, " shapes"] | None = None
) -> Float[np.ndarray, "joints 3"]:
    """Unit vectors from head to tail of every bone at rest."""
    rest = body.rest_vertices(body.default_shape() if shape is None else shape)
    heads, tails = (np.asarray(x, dtype=np.float64) for x in body.joint_positions(rest))
    d = tails - heads
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def align_global(
    body: Body,
    targets: Mapping[str, Float[np.ndarray, "3"]],
    shape: Float[Array, " shapes"] | None = None,
) -> list[Rotation]:
    """World rotations, relative to rest, that align named bones with given directions.

    A bone without a target keeps its orientation relative to its parent.
    """
    directions = bone_directions(body, shape)
    world: list[Rotation] = []
    for j, parent in enumerate(body.parents):
        inherited = world[parent] if parent >= 0 else Rotation.identity()
        target = targets.get(body.joint_names[j])
        if target is None:
            world.append(inherited)
        else:
            now = inherited.apply(directions[j])
            world.append(smallest_rotation(now, np.asarray(target)) * inherited)
    return world


def align_bones(
    body: Body,
    targets: Mapping[str, Float[np.ndarray, "3"]],
    shape: Float[Array, " shapes"] | None = None,
) -> Float[np.ndarray, "joints 4"]:
    """Local quaternions (wxyz) for the rotations of `align_global`."""
    world = align_global(body, targets, shape)
    local = [r if p < 0 else world[p].inv() * r for r, p in zip(world, body.parents, strict=True)]
    quaternions = np.stack([r.as_quat(scalar_first=True) for r in local])
    return np.where(quaternions[:, :1] < 0, -quaternions, quaternions)


def t_pose(body: Body, shape: Float[Array, " shapes"] | None = None) -> Float[Array, "joints 4"]:
    """A T-pose: arms along the X axis, legs straight down; computed on the host.

    Bones are turned by the smallest rotation, the forearm after the upper arm.
    """
    x, down = np.array([1.0, 0.0, 0.0]), np.array([0.0, -1.0, 0.0])
    targets = {}
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        targets |= {f"{side}Arm": sign * x, f"{side}ForeArm": sign * x}
        targets |= {f"{side}UpLeg": down, f"{side}Leg": down}
    return jnp.asarray(align_bones(body, targets, shape), jnp.float32)
