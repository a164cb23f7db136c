"""Where the body passes through itself: how much room cloth has between two limbs."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.spatial import KDTree

from ...body import HANDS, Body, body_segments
from ...geometry import spread_points
from ...typing import pytree
from .._assembly import float32
from .._effect import Placed

# Distance between the samples of the skin [m].
_SPACING = 0.03
# Skin nearer than this at rest belongs together [m].
_APART = 0.06
# Unless it already faces itself across this or more [m].
_ASIDE = 0.01
# Skin deeper than this below another's lies on the far side of a limb [m].
_DEEP = 0.06
# Positions are told from the nearest of places this far apart [m].
_GRID = 16.0
# Lateral reach of the test at rest that tells the far side of a limb [m].
_BROAD = 0.08
# More room than this is no pinch [m].
ROOM = 0.05


@pytree
@dataclasses.dataclass(frozen=True)
class Pinch:
    """Samples of the skin, and which of them can meet.

    Attributes:
        samples: Rows of the skin's vertices.
        facing: Pairs of samples that can come to face each other.
        near: Samples around each skin vertex, of which room is interpolated.
        weights: Their weights.
    """

    samples: Int[Array, " samples"]
    facing: Bool[Array, "samples samples"]
    near: Int[Array, "3 skin"]
    weights: Float[Array, "3 skin 1"]

    def room(self, skin: Placed) -> Float[Array, "skin batch"]:
        """Height of each skin vertex over the skin that faces it [m], at most `ROOM`.

        Negative where the body passes through itself.
        """
        p, n = skin.points[self.samples], skin.normals[self.samples]
        stop = jax.lax.stop_gradient
        # Squares of coordinates far from the origin would drown the distances.
        p = p - stop(_GRID * jnp.round(jnp.mean(p, axis=0, keepdims=True) / _GRID))
        squared = jnp.sum(p * p, axis=1)
        # The points' own squared length doesn't change which is the nearest.
        gap = squared[None] - 2.0 * jnp.einsum(
            "sib,tib->stb", stop(p), stop(p), precision=jax.lax.Precision.HIGHEST
        )
        nearest = jnp.argmin(jnp.where(self.facing[..., None], gap, jnp.inf), axis=1)
        lane = jnp.arange(p.shape[2], dtype=nearest.dtype)[None]
        away = p - jnp.moveaxis(p[nearest, :, lane], -1, 1)
        normal = jnp.moveaxis(n[nearest, :, lane], -1, 1)
        height = jnp.sum(away * normal, axis=1)
        beside = jnp.sum(away * away, axis=1) - height**2
        opposed = jnp.sum(n * normal, axis=1) < 0
        meets = (
            (height > -_DEEP)
            & (beside < _SPACING**2)
            & opposed
            & jnp.any(self.facing, axis=1)[:, None]
        )
        room = jnp.where(meets, jnp.minimum(height, ROOM), ROOM)
        return jnp.sum(self.weights * room[self.near], axis=0)


def prepare_pinch(
    skin: Float[np.ndarray, "skin 3"],
    normals: Float[np.ndarray, "skin 3"],
    weights: Float[np.ndarray, "skin joints"],
    body: Body,
) -> Pinch:
    """Samples the skin and finds at rest which parts of it are no single limb's two sides."""
    pool = np.asarray(spread_points(skin, _SPACING))
    bone = body_segments(weights[pool], body)
    away = skin[pool][:, None] - skin[pool][None]
    squared = (away**2).sum(axis=2)
    height = np.einsum("stk,tk->st", away, normals[pool])
    # Fingers have no one side that cloth could keep to: hands pass through it.
    hand = np.isin(bone, HANDS)
    across = (height < 0) & (squared - height**2 < _BROAD**2)
    opposed = normals[pool] @ normals[pool].T < 0
    beside = (squared < _APART**2) & ~(opposed & (height > _ASIDE))
    facing = (bone[:, None] != bone[None]) & ~beside & ~across
    facing &= ~hand[:, None] & ~hand[None]
    k = min(3, len(pool))
    far, near = KDTree(skin[pool]).query(skin, k=k)
    far, near = far.reshape(len(skin), k), near.reshape(len(skin), k)
    w = 1.0 / (far + 1e-3)
    w = w / w.sum(axis=1, keepdims=True)
    return Pinch(
        jnp.asarray(pool.astype(np.int32)),
        jnp.asarray(facing),
        jnp.asarray(near.T.astype(np.int32)),
        float32(w.T[..., None]),
    )
