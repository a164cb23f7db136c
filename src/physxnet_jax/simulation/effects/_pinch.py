"""Pinches: the gap for cloth between two limbs, also where the body intersects itself."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.spatial import KDTree

from ...body import HANDS, Body, body_segments
from ...geometry import nearest_index, spread_points
from ...typing import pytree
from .._assembly import float32
from .._effect import PosedPoints

# Distance between the samples of the skin [m].
_SPACING = 0.03
# Samples closer than this at rest never count as facing each other [m], ...
_MIN_REST_DISTANCE = 0.06
# ... unless they already do at rest, across more than this [m].
_MIN_REST_GAP = 0.01
# Skin deeper than this below facing skin lies on the far side of a limb [m].
_MAX_DEPTH = 0.06
# Lateral reach of the test at rest that detects the far side of a limb [m].
_LATERAL_REACH = 0.08
# Larger gaps aren't pinches [m].
ROOM = 0.05


@pytree
@dataclasses.dataclass(frozen=True)
class Pinch:
    """Samples of the skin, and pairs of them that can face each other.

    Attributes:
        samples: Skin vertices of the samples.
        facing: For each sample in a column, the samples that it can face.
        paired: Samples that are in such a pair.
        near: Samples around each skin vertex, from which its gap is interpolated.
        weights: Interpolation weights.
    """

    samples: Int[Array, " samples"]
    facing: Bool[Array, "samples samples"]
    paired: Bool[Array, "samples 1"]
    near: Int[Array, "3 skin"]
    weights: Float[Array, "3 skin 1"]

    def room(self, skin: PosedPoints) -> Float[Array, "skin batch"]:
        """Height of each skin vertex over the skin that faces it [m], at most `ROOM`.

        Negative where the body intersects itself.
        """
        p, n = skin.points[self.samples], skin.normals[self.samples]
        gaps = [p[None, :, i] - p[:, None, i] for i in range(3)]
        gap = gaps[0] ** 2 + gaps[1] ** 2 + gaps[2] ** 2
        gap = jnp.where(self.facing[..., None], gap, jnp.inf)
        closest = nearest_index(jax.lax.stop_gradient(gap))
        lane = jnp.arange(p.shape[2])[None]
        away = p - jnp.moveaxis(p[closest, :, lane], -1, 1)
        normal = jnp.moveaxis(n[closest, :, lane], -1, 1)
        height = jnp.sum(away * normal, axis=1)
        beside = jnp.sum(away * away, axis=1) - height**2
        opposed = jnp.sum(n * normal, axis=1) < 0
        valid = (height > -_MAX_DEPTH) & (beside < _SPACING**2) & opposed & self.paired
        room = jnp.where(valid, jnp.minimum(height, ROOM), ROOM)
        return jnp.sum(self.weights * room[self.near], axis=0)


def prepare_pinch(
    skin: Float[np.ndarray, "skin 3"],
    normals: Float[np.ndarray, "skin 3"],
    weights: Float[np.ndarray, "skin joints"],
    body: Body,
) -> Pinch:
    """Samples the skin and finds, at rest, the pairs that aren't two sides of one limb."""
    pool = np.asarray(spread_points(skin, _SPACING))
    bone = body_segments(weights[pool], body)
    away = skin[pool][:, None] - skin[pool][None]
    squared = (away**2).sum(axis=2)
    height = np.einsum("stk,tk->st", away, normals[pool])
    # Fingers have no single side on which cloth could stay: hands pass through it.
    hand = np.isin(bone, HANDS)
    across = (height < 0) & (squared - height**2 < _LATERAL_REACH**2)
    opposed = normals[pool] @ normals[pool].T < 0
    beside = (squared < _MIN_REST_DISTANCE**2) & ~(opposed & (height > _MIN_REST_GAP))
    facing = (bone[:, None] != bone[None]) & ~beside & ~across
    facing &= ~hand[:, None] & ~hand[None]
    k = min(3, len(pool))
    far, near = KDTree(skin[pool]).query(skin, k=k)
    far, near = far.reshape(len(skin), k), near.reshape(len(skin), k)
    w = 1.0 / (far + 1e-3)
    w = w / w.sum(axis=1, keepdims=True)
    return Pinch(
        jax.device_put(pool.astype(np.int32)),
        # Transposed: the search looks for the other sample along the first axis.
        jax.device_put(facing.T),
        jax.device_put(facing.any(axis=1, keepdims=True)),
        jax.device_put(near.T.astype(np.int32)),
        float32(w.T[..., None]),
    )
