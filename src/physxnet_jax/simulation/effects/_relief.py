"""Relief of the skin: what rises beside a point, and would come through a flat triangle."""

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

# Larger rises are folds of the body, into which cloth may go [m].
_MAX_RELIEF = 0.006


def relief(
    skin: Float[np.ndarray, "skin 3"], normals: Float[np.ndarray, "skin 3"], reach: float
) -> Float[np.ndarray, " skin"]:
    """Rise of the skin within ``reach`` over each vertex's tangent plane [m].

    A triangle whose corners keep this distance lies over features smaller than itself. Skin
    that faces away, as on the other side of a crease, doesn't count.

    Args:
        skin: Skin vertices at rest [m].
        normals: Their unit normals.
        reach: Largest distance to a triangle's corner [m].
    """
    pairs = KDTree(skin).query_pairs(reach, output_type="ndarray")
    i, j = np.concatenate([pairs, pairs[:, ::-1]]).T
    together = np.einsum("ij,ij->i", normals[i], normals[j]) > 0
    rise = np.einsum("ij,ij->i", skin[j] - skin[i], normals[i])
    out = np.zeros(len(skin))
    np.maximum.at(out, i, np.where(together, rise, 0.0))
    return np.minimum(out, _MAX_RELIEF)
