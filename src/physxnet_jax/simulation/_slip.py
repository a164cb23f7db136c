"""How far garments have slid along the body."""

import numpy as np
from jaxtyping import Float

from ..motion import Motion, animate
from ._assembly import Assembly, float32

# Vertices are padded to multiples of this: one program for most garments.
_PADDED = 128


def slipped(
    assembly: Assembly, motion: Motion, positions: Float[np.ndarray, "frames vertices 3"]
) -> Float[np.ndarray, "frames garments"]:
    """How far the curves that hold garments have slid from their place on the skin.

    Args:
        assembly: Garments and body, see `PreparedScene`.
        motion: The body's motion.
        positions: Cloth of all garments [m].

    Returns:
        For each frame and garment, the largest distance of a holding curve's middle from where the
        skin has carried it [m], see `holding_loops`; 0 for a garment without one.
    """
    curves = [(k, c) for k, curves in enumerate(assembly.holds) for c in curves]
    out = np.zeros((len(positions), len(assembly.holds)))
    if not curves:
        return out
    vertices = np.concatenate([c for _, c in curves])
    padded = np.resize(vertices, -(-len(vertices) // _PADDED) * _PADDED)
    rest, weights = float32(assembly.rest[padded]), float32(assembly.weights[padded])
    carried = np.asarray(animate(assembly.body, float32(assembly.rest_body), rest, weights, motion))
    gap = np.asarray(positions[:, vertices], np.float64) - carried[:, : len(vertices)]
    start = 0
    for k, curve in curves:
        middle = gap[:, start : start + len(curve)].mean(axis=1)
        out[:, k] = np.maximum(out[:, k], np.linalg.norm(middle, axis=1))
        start += len(curve)
    return out
