"""Rotations: unit quaternions (wxyz), matrices, axis-angle. Smooth at the identity."""

from collections.abc import Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

_A = TypeVar("_A", Array, np.ndarray)
_Entries = tuple[tuple[Array, ...], ...]

# Below this squared angle [rad^2] the series replaces sin(x)/x: the error is under 1e-9.
_SMALL = 1e-6


def safe_normalize(vectors: Float[_A, "*batch n"], *, eps: float = 1e-12) -> Float[_A, "*batch n"]:
    """Unit vectors along the last axis; the zero vector stays zero.

    Value and gradient are finite everywhere: vectors no longer than ``eps`` become zero,
    and so do their gradients.

    Args:
        vectors: Any vectors.
        eps: Length under which a vector counts as zero [same unit].

    Returns:
        Vectors of length one (or zero). NumPy arrays give NumPy arrays.
    """
    xp: Any = np if isinstance(vectors, np.ndarray) else jnp
    squared = xp.sum(vectors * vectors, axis=-1, keepdims=True)
    tiny = squared <= eps * eps
    length = xp.sqrt(xp.where(tiny, xp.ones_like(squared), squared))
    return xp.where(tiny, xp.zeros_like(vectors), vectors / length)


def safe_norm(vectors: Float[Array, "*batch n"]) -> Float[Array, "*batch"]:
    """Length along the last axis; its gradient is zero at the zero vector."""
    squared = jnp.sum(vectors * vectors, axis=-1)
    zero = squared <= 0.0
    return jnp.where(
        zero,
        jnp.zeros_like(squared),
        jnp.sqrt(jnp.where(zero, jnp.ones_like(squared), squared)),
    )


def quaternion_from_axis_angle(
    rotvec: Float[Array, "*batch 3"],
) -> Float[Array, "*batch 4"]:
    """Quaternion wxyz of a rotation vector [rad], smooth through zero."""
    squared = jnp.sum(rotvec * rotvec, axis=-1, keepdims=True)
    small = squared < _SMALL
    angle = jnp.sqrt(jnp.where(small, jnp.ones_like(squared), squared))
    half_sinc = jnp.where(small, 0.5 - squared / 48.0, jnp.sin(0.5 * angle) / angle)
    cos = jnp.where(small, 1.0 - squared / 8.0, jnp.cos(0.5 * angle))
    return jnp.concatenate([cos, half_sinc * rotvec], axis=-1)


def quaternion_multiply(
    a: Float[Array, "*batch 4"], b: Float[Array, "*batch 4"]
) -> Float[Array, "*batch 4"]:
    """Hamilton product ``a b``: rotate by ``b``, then by ``a``."""
    aw, ax, ay, az = (a[..., i] for i in range(4))
    bw, bx, by, bz = (b[..., i] for i in range(4))
    return jnp.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


def quaternion_conjugate(q: Float[Array, "*batch 4"]) -> Float[Array, "*batch 4"]:
    """The inverse of a unit quaternion."""
    return jnp.concatenate([q[..., :1], -q[..., 1:]], axis=-1)


def matrix_from_quaternion(q: Float[Array, "*batch 4"]) -> Float[Array, "*batch 3 3"]:
    """Rotation matrices; ``q`` is normalised first, so any nonzero q is a rotation."""
    q = safe_normalize(q)
    w, x, y, z = (q[..., i] for i in range(4))
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def polar_rotation(
    matrices: Float[Array, "*batch 3 3"], *, steps: int = 6
) -> Float[Array, "*batch 3 3"]:
    """Nearest rotation of blended rotation matrices, by Newton-Schulz iteration.

    Converges if every singular value lies in (0, sqrt(3)), to a rotation if the determinant
    is positive. Both hold for blends of two rotations, except opposite ones. Those stay
    singular and finite: without division and square root, value and gradient have no NaN.
    Blends of three rotations far apart may have a negative determinant; the result is then
    a reflection.

    Args:
        matrices: Convex combinations of rotation matrices.
        steps: Iterations; six reach float32 accuracy for blends up to 120 degrees.

    Returns:
        Orthonormal matrices.

    References:
        Higham, Functions of Matrices (2008), section 8.3.
    """

    def step(x: _Entries, _: None) -> tuple[_Entries, None]:
        columns = list(zip(*x, strict=True))
        gram = [[_dot(a, b) for b in columns] for a in columns]
        return tuple(
            tuple(
                1.5 * entry - 0.5 * _dot(row, other) for entry, other in zip(row, gram, strict=True)
            )
            for row in x
        ), None

    # Entry by entry: several times as fast as products of small matrices. A loop, because the
    # compiler would write the steps out as one expression that grows with a power of their number.
    start = tuple(tuple(matrices[..., i, k] for k in range(3)) for i in range(3))
    rows, _ = jax.lax.scan(step, start, None, length=steps)
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def _dot(a: Sequence[Array], b: Sequence[Array]) -> Array:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def slerp(
    a: Float[np.ndarray, "*batch 4"],
    b: Float[np.ndarray, "*batch 4"],
    t: Float[np.ndarray, "*#batch 1"],
) -> Float[np.ndarray, "*batch 4"]:
    """Spherical interpolation of unit quaternions along the shorter arc.

    Nearly equal quaternions are interpolated linearly and normalised. This runs on the
    host, as every clip length would need its own compilation.
    """
    dot = np.sum(a * b, axis=-1, keepdims=True)
    b = np.where(dot < 0, -b, b)
    dot = np.minimum(np.abs(dot), 1.0)
    near = dot > 0.9995
    theta = np.arccos(np.where(near, 0.0, dot))
    sine = np.sin(theta)
    wa = np.where(near, 1.0 - t, np.sin((1.0 - t) * theta) / sine)
    wb = np.where(near, t, np.sin(t * theta) / sine)
    q = wa * a + wb * b
    return q / np.linalg.norm(q, axis=-1, keepdims=True)
