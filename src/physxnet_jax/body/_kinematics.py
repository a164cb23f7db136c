"""Forward kinematics and linear blend skinning."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..geometry import matrix_from_quaternion

# Skinning moves metres: a GPU's default of ten-bit mantissas would cost millimetres.
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
    # A joint more, at the root and never turned: what the root hangs on.
    level, above = (jnp.asarray(x) for x in _levels(parents))
    over = np.array(parents)
    offset = jnp.where(over[:, None] < 0, jnp.zeros((), heads.dtype), heads - heads[over])
    offset = jnp.concatenate([offset, jnp.zeros((1, 3), heads.dtype)])
    local = matrix_from_quaternion(pose)
    one = jnp.eye(3, dtype=local.dtype)[None]
    local = jnp.concatenate([local, one])
    # All but the last row are overwritten; what a scan carries has to vary over a mesh of
    # devices (`jax.shard_map`) from its start as it does at its end.
    world, place = local, root[None] + 0.0 * local[:, 0]

    def descend(
        state: tuple[Array, Array], rows: tuple[Array, Array]
    ) -> tuple[tuple[Array, Array], None]:
        world, place = state
        row, up = rows
        turn, here = world[up], jnp.minimum(row, joints)
        # Sums written out: a product of small matrices takes many times as long to compile.
        turned = jnp.sum(turn[:, :, :, None] * local[here][:, None], axis=2)
        moved = place[up] + jnp.sum(turn * offset[here][:, None], axis=2)
        put = {"mode": "drop", "unique_indices": True}
        return (world.at[row].set(turned, **put), place.at[row].set(moved, **put)), None

    (world, place), _ = jax.lax.scan(descend, (world, place), (level, above))
    world, place = world[:joints], place[:joints]
    return world, place - jnp.einsum("jab,jb->ja", world, heads, precision=_EXACT)


@functools.cache
def _levels(
    parents: tuple[int, ...],
) -> tuple[Int[np.ndarray, "levels most"], Int[np.ndarray, "levels most"]]:
    """Joints of equal depth, filled up with rows that don't exist, and their parents."""
    spare = len(parents)
    depth: list[int] = []
    for parent in parents:
        depth.append(0 if parent < 0 else depth[parent] + 1)
    rows = [np.flatnonzero(np.array(depth) == d) for d in range(max(depth) + 1)]
    most = max(map(len, rows))
    level = np.tile(np.arange(spare + 1, spare + 1 + most, dtype=np.int32), (len(rows), 1))
    for into, row in zip(level, rows, strict=True):
        into[: len(row)] = row
    over = np.array([spare if parent < 0 else parent for parent in (*parents, spare)], np.int32)
    return level, over[np.minimum(level, spare)]


def linear_blend_skinning(
    vertices: Float[Array, "vertices 3"],
    weights: Float[Array, "vertices joints"],
    rotations: Float[Array, "joints 3 3"],
    translations: Float[Array, "joints 3"],
) -> Float[Array, "vertices 3"]:
    """Vertices moved by the weighted mean of their joints' transforms.

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
