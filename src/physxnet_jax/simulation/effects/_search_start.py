"""Skin vertices at which searches for contact start, from the clothes at rest."""

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from ...body import Body
from ...geometry import spread_points
from .._assembly import Assembly
from ._limbs import LOWER_ARMS, TRUNK, UPPER_ARMS, limb_labels


def sleeve_labels(
    weights: Float[np.ndarray, "points joints"], body: Body
) -> Int[np.ndarray, " points"]:
    """Limb labels, between which tight garments don't slide; each arm is one limb."""
    label = limb_labels(weights, body)
    for upper, lower in zip(UPPER_ARMS, LOWER_ARMS, strict=True):
        label[label == lower] = upper
    return label


def starting_vertices(
    assembly: Assembly,
    skin: Float[np.ndarray, "body 3"],
    used: Int[np.ndarray, " used"],
    label: Int[np.ndarray, " body"],
    rows: Int[np.ndarray, " tight"],
) -> Int[np.ndarray, " tight"]:
    """The nearest skin vertex of the same limb for each cloth vertex at rest."""
    cloth = sleeve_labels(assembly.weights, assembly.body)[rows]
    out = np.zeros(len(rows), dtype=np.int64)
    for lab in np.unique(cloth):
        selected = cloth == lab
        # Cloth of a limb starts on that limb or the trunk, cloth of the trunk anywhere.
        pool = used if lab == TRUNK else used[(label[used] == lab) | (label[used] == TRUNK)]
        pool = pool if len(pool) else used
        out[selected] = pool[KDTree(skin[pool]).query(assembly.rest[rows[selected]])[1]]
    return out


def patch_centres(
    assembly: Assembly,
    skin: Float[np.ndarray, "body 3"],
    used: Int[np.ndarray, " used"],
    rows: Int[np.ndarray, " loose"],
    spacing: float,
    count: int,
) -> Int[np.ndarray, "loose k"]:
    """Skin vertices whose patches each loose vertex compares."""
    pool = used[spread_points(skin[used], spacing)]
    k = min(count, len(pool))
    return pool[KDTree(skin[pool]).query(assembly.rest[rows], k=k)[1].reshape(len(rows), k)]
