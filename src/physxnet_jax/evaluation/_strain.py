"""Edge strain of cloth, computed from positions alone."""

import numpy as np
from jaxtyping import Float

from ..geometry import mesh_edges
from ..simulation import Assembly


def edge_strain(
    assembly: Assembly, positions: Float[np.ndarray, "frames vertices 3"]
) -> Float[np.ndarray, "frames edges"]:
    """Relative change of every edge's length from rest [1]."""
    a, b = mesh_edges(assembly.faces).vertices.T
    rest = np.linalg.norm(assembly.rest[a] - assembly.rest[b], axis=1)
    length = np.linalg.norm(positions[:, a] - positions[:, b], axis=2)
    return length / np.maximum(rest, 1e-6) - 1.0
