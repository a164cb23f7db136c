"""Forward kinematics and linear blend skinning."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..geometry import matrix_from_quaternion

# Positions span metres: the ten-bit mantissas that GPUs use by default would lose millimetres.
_EXACT = jax.lax.Precision.HIGHEST


def forward_kinematics(
    parents: tuple[int, ...],
    heads: Float[Array, "joints 3"],
    pose: Float[Array, "joints 4"],
    root: Float[Array, "3"],
) -> tuple[Float[Array, "joints 3 3"], Float[Array, "joints 3"]]:
    """World transforms of joints, relative to the rest pose.

    Joint frames are aligned with the world at rest, so a pose of identities is the
    rest pose. A rest point ``x`` that follows joint ``j`` moves to
    ``rotations[j] @ x + translations[j]``.

    Args:
        parents: Parent of every joint, -1 for the root; parents come first.
        heads: Joint positions at rest [m].
        pose: Local rotations, wxyz (normalised here).
        root: World position of the first joint [m].

    Returns:
        World rotations and translations [m] of every joint.
    """
    joints = len(parents)
    # An extra joint at the root, never rotated, serves as the root's parent.
    level, above = (jnp.asarray(x) for x in _levels(parents))
    parent_rows = np.array(parents)
    offset = jnp.where(
        parent_rows[:, None] < 0, jnp.zeros((), heads.dtype), heads - heads[parent_rows]
    )
    offset = jnp.concatenate([offset, jnp.zeros((1, 3), heads.dtype)])
    local = matrix_from_quaternion(pose)
    one = jnp.eye(3, dtype=local.dtype)[None]
    local = jnp.concatenate([local, one])
    # All but the last row are overwritten. Under `jax.shard_map` a scan's carry has to vary
    # over the devices at its start as it does at its end, hence the product with zero.
    world, position = local, root[None] + 0.0 * local[:, 0]

    def descend(
        state: tuple[Array, Array], rows: tuple[Array, Array]
    ) -> tuple[tuple[Array, Array], None]:
        world, position = state
        row, up = rows
        turn, here = world[up], jnp.minimum(row, joints)
        # Explicit sums: a product of small matrices takes many times as long to compile.
        turned = jnp.sum(turn[:, :, :, None] * local[here][:, None], axis=2)
        moved = position[up] + jnp.sum(turn * offset[here][:, None], axis=2)
        scatter_options = {"mode": "drop", "unique_indices": True}
        return (
            world.at[row].set(turned, **scatter_options),
            position.at[row].set(moved, **scatter_options),
        ), None

    (world, position), _ = jax.lax.scan(descend, (world, position), (level, above))
    world, position = world[:joints], position[:joints]
    return world, position - jnp.einsum("jab,jb->ja", world, heads, precision=_EXACT)


@functools.cache
def _levels(
    parents: tuple[int, ...],
) -> tuple[Int[np.ndarray, "levels most"], Int[np.ndarray, "levels most"]]:
    """Joints grouped by depth, padded with out-of-range rows, and their parents."""
    spare = len(parents)
    depth: list[int] = []
    for parent in parents:
        depth.append(0 if parent < 0 else depth[parent] + 1)
    rows = [np.flatnonzero(np.array(depth) == d) for d in range(max(depth) + 1)]
    most = max(map(len, rows))
    level = np.tile(np.arange(spare + 1, spare + 1 + most, dtype=np.int32), (len(rows), 1))
    for into, row in zip(level, rows, strict=True):
        into[: len(row)] = row
    parent_rows = np.array(
        [spare if parent < 0 else parent for parent in (*parents, spare)], np.int32
    )
    return level, parent_rows[np.minimum(level, spare)]


def linear_blend_skinning(
    vertices: Float[Array, "vertices 3"],
    weights: Float[Array, "vertices joints"],
    rotations: Float[Array, "joints 3 3"],
    translations: Float[Array, "joints 3"],
) -> Float[Array, "vertices 3"]:
    """Moves vertices by the weighted mean of their joints' transforms.

    Args:
        vertices: Rest positions [m].
        weights: Skinning weights, rows sum to 1.
        rotations: World rotations of joints, from `forward_kinematics`.
        translations: World translations of joints [m].

    Returns:
        Posed positions [m].
    """
    blend = blend_rotations(weights, rotations)
    shift = jnp.matmul(weights, translations, precision=_EXACT)
    return jnp.einsum("vab,vb->va", blend, vertices, precision=_EXACT) + shift


def blend_rotations(
    weights: Float[Array, "vertices joints"],
    rotations: Float[Array, "joints 3 3"],
) -> Float[Array, "vertices 3 3"]:
    """The linear part of skinning: weighted means of joint rotations."""
    flat = rotations.reshape(rotations.shape[0], 9)
    return jnp.matmul(weights, flat, precision=_EXACT).reshape(-1, 3, 3)


def skin_points(
    rest: Float[Array, "points 3"],
    weights: Float[Array, "points joints"],
    rotations: Float[Array, "joints 3 3"],
    translations: Float[Array, "joints 3"],
) -> tuple[Float[Array, "points 3"], Float[Array, "points 3 3"]]:
    """Skinned points [m] and the linear part of their skinning."""
    blend = blend_rotations(weights, rotations)
    shift = jnp.matmul(weights, translations, precision=_EXACT)
    return jnp.einsum("pab,pb->pa", blend, rest, precision=_EXACT) + shift, blend
