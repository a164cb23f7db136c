"""Vertex errors of a dressed garment against its reference."""

import dataclasses

import numpy as np
from jaxtyping import Float


@dataclasses.dataclass(frozen=True)
class VertexError:
    """Distances between two animations of one mesh.

    The paper's "MSE in mm" can mean the MSE [mm^2] or its root [mm], so both are given.

    Attributes:
        mse_mm2: Mean squared distance of vertices [mm^2].
        rmse_mm: Its root [mm].
        mean_mm: Mean distance [mm].
        p95_mm: 95th percentile of distances [mm].
        max_mm: Largest distance [mm].
    """

    mse_mm2: float
    rmse_mm: float
    mean_mm: float
    p95_mm: float
    max_mm: float


def vertex_error(
    positions: Float[np.ndarray, "frames vertices 3"],
    reference: Float[np.ndarray, "frames vertices 3"],
) -> VertexError:
    """Vertex distances over all frames.

    Args:
        positions: Positions [m].
        reference: Reference positions [m].

    Returns:
        The error.

    Raises:
        ValueError: The shapes differ, or there is no vertex.

    References:
        PhysXNet, section 5.2.
    """
    if positions.shape != reference.shape or positions.size == 0:
        raise ValueError(
            f"positions {positions.shape} and reference {reference.shape} must have the"
            " same shape and at least one vertex."
        )
    gap = positions.astype(np.float64) - reference
    distance = 1e3 * np.linalg.norm(gap, axis=2)
    squared = float(np.mean(distance**2))
    return VertexError(
        squared,
        float(np.sqrt(squared)),
        float(distance.mean()),
        float(np.percentile(distance, 95)),
        float(distance.max()),
    )
