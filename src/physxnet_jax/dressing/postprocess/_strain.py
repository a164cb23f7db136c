"""Strain limiting: restores edges to about their rest lengths."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Array, Float

from ...garment import SkinnedGarment
from ...geometry import EdgeConstraints, limit_strain, make_edge_constraints, map_frames
from ...typing import pytree
from .._inference import Inference
from ._outfit import Cloth, Outfit


@pytree
@dataclasses.dataclass(frozen=True, kw_only=True)
class StrainLimits:
    """Edge constraints of each garment.

    Attributes:
        constraints: Constraints of each garment, in the order worn.
        iterations: Projections per frame.
    """

    constraints: tuple[EdgeConstraints, ...]
    iterations: int = dataclasses.field(metadata={"static": True})


def prepare_strain(outfit: Outfit, inference: Inference) -> StrainLimits | None:
    """Makes constraints along the edges of every garment.

    Args:
        outfit: The garments.
        inference: Its ``strain_iterations`` enable the step.
    """
    if not inference.strain_iterations:
        return None
    constraints = tuple(
        make_edge_constraints(np.asarray(w.rest), np.asarray(g.mesh.faces))
        for w, g in zip(outfit.worn, outfit.garments, strict=True)
    )
    return StrainLimits(constraints=constraints, iterations=inference.strain_iterations)


def apply_strain(
    limits: StrainLimits,
    cloth: Cloth,
    rotations: Float[Array, "frames joints 3 3"],
    translations: Float[Array, "frames joints 3"],
) -> Cloth:
    """Restores edges to about their rest lengths, frame by frame; see `limit_strain`."""
    del rotations, translations
    return tuple(
        map_frames(lambda x, c=constraints: limit_strain(c, x, limits.iterations), garment)
        for constraints, garment in zip(limits.constraints, cloth, strict=True)
    )


def reshape_strain(limits: StrainLimits, worn: Sequence[SkinnedGarment]) -> StrainLimits:
    """Replaces rest lengths by those of another body shape."""
    pairs = zip(limits.constraints, worn, strict=True)
    return dataclasses.replace(limits, constraints=tuple(c.at_rest(w.rest) for c, w in pairs))
