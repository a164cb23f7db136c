"""Forward kinematics and linear blend skinning."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

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
    local = matrix_from_quaternion(pose)
    rotations: list[Array] = []
    positions: list[Array] = []
    for j, parent in enumerate(parents):
        if parent < 0:
            rotations.append(local[j])
            positions.append(root)
        else:
            offset = heads[j] - heads[parent]
            up = rotations[parent]
            rotations.append(jnp.matmul(up, local[j], precision=_EXACT))
            positions.append(positions[parent] + jnp.matmul(up, offset, precision=_EXACT))
    world = jnp.stack(rotations)
    shift = jnp.stack(positions) - jnp.einsum("jab,jb->ja", world, heads, precision=_EXACT)
    return world, shift


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
