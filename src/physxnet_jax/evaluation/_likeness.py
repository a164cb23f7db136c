"""How like a simulation cloth is, in position, folds, strain and motion."""

import dataclasses
import math

import numpy as np
from jaxtyping import Float

from ..simulation import Assembly
from ._metrics import vertex_error
from ._motion_metrics import (
    fold_spectrum,
    fold_strength,
    jitter,
    spectrum_distance,
    wrinkle_error,
)
from ._strain import edge_strain

LOOK_STRIDE = 15
"""Every so manieth frame is looked at where a look takes long."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Likeness:
    """Cloth beside a reference of the same mesh and motion.

    Attributes:
        rmse_mm: Root mean square distance of vertices [mm].
        folds: `fold_strength` over the reference's [1].
        wrinkle_deg: `wrinkle_error` [degrees].
        spectrum: `spectrum_distance` between the `fold_spectrum` of both [1].
        tension: 99th percentile of the strain of edges over the reference's [1].
        jerk: `jitter` over the reference's [1].
    """

    rmse_mm: float
    folds: float
    wrinkle_deg: float
    spectrum: float
    tension: float
    jerk: float


def likeness(
    assembly: Assembly,
    cloth: Float[np.ndarray, "frames vertices 3"],
    reference: Float[np.ndarray, "frames vertices 3"],
    *,
    fps: float,
) -> Likeness:
    """Compares cloth with a reference.

    Ratios are NaN where the reference has none of it.

    Args:
        assembly: The garment alone, from `prepare_scene`.
        cloth: Positions [m].
        reference: Positions of the same vertices at the same times [m].
        fps: Frames per second.
    """
    faces = np.asarray(assembly.faces)

    def tension(x: np.ndarray) -> float:
        return float(np.quantile(edge_strain(assembly, x), 0.99))

    found, wanted = (
        fold_spectrum(assembly.rest, faces, x[::LOOK_STRIDE]) for x in (cloth, reference)
    )
    return Likeness(
        rmse_mm=vertex_error(cloth, reference).rmse_mm,
        folds=_ratio(fold_strength(faces, cloth), fold_strength(faces, reference)),
        wrinkle_deg=wrinkle_error(faces, cloth, reference),
        spectrum=spectrum_distance(found, wanted),
        tension=_ratio(tension(cloth), tension(reference)),
        jerk=_ratio(jitter(cloth, fps), jitter(reference, fps)),
    )


def _ratio(of: float, over: float) -> float:
    return of / over if over > 0.0 else math.nan
