"""Relief of the skin: what would come through a flat triangle that lies on it."""

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

# Largest relief: fingers and toes aren't covered by single triangles [m].
_MAX_RELIEF = 0.010
# Neighbours farther than this share of the reach stand for a triangle's corners.
_RING = 0.6


def relief(
    skin: Float[np.ndarray, "skin 3"], normals: Float[np.ndarray, "skin 3"], reach: float
) -> Float[np.ndarray, " skin"]:
    """Height at which a triangle's corners must lie for its middle to touch the skin [m].

    Each vertex rises over the plane of the skin around it, at the distance of a triangle's
    corners. A corner must be as high as the largest rise within its reach. Skin that faces
    away, as on the other side of a crease, doesn't count.

    Args:
        skin: Skin vertices at rest [m].
        normals: Their unit normals.
        reach: Distance of a triangle's middle from its corners [m].
    """
    pairs = KDTree(skin).query_pairs(reach, output_type="ndarray")
    i, j = np.concatenate([pairs, pairs[:, ::-1]]).T
    together = np.einsum("ij,ij->i", normals[i], normals[j]) > 0
    i, j = i[together], j[together]
    away = skin[j] - skin[i]
    ring = np.einsum("ij,ij->i", away, away) > (_RING * reach) ** 2
    fall = -np.einsum("ij,ij->i", away, normals[i])
    count = np.maximum(np.bincount(i[ring], minlength=len(skin)), 1)
    rise = np.bincount(i[ring], fall[ring], minlength=len(skin)) / count
    out = np.maximum(rise, 0.0)
    np.maximum.at(out, i, rise[j])
    return np.clip(out, 0.0, _MAX_RELIEF)
