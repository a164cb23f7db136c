"""Options of prediction and post-processing."""

import dataclasses
import pathlib

from ..errors import PhysXNetError, check_flags
from ..models import DEFAULT, Predictor


@dataclasses.dataclass(frozen=True, kw_only=True)
class Inference:
    """Options of prediction and post-processing, shared by Python, CLI, viewer and evaluation.

    Attributes:
        weights: Name or folder of network weights, or a predictor.
        tta: Average with the prediction for the mirrored pose (test-time augmentation):
            doubles the cost of the network.
        strain_iterations: Iterations of strain limiting after the network, which restores
            edges to about their rest lengths; 0 disables it. Skinning alone is never limited.
        collisions: Resolve collisions with the body, and keep garments in the order of their
            layers.

    Example:
        >>> Inference(weights="nano", collisions=False).strain_iterations
        8
    """

    weights: str | pathlib.Path | Predictor = DEFAULT
    tta: bool = False
    strain_iterations: int = 8
    collisions: bool = True

    def __post_init__(self) -> None:
        count = self.strain_iterations
        if not isinstance(count, int) or isinstance(count, bool) or count < 0:
            raise PhysXNetError(f"strain_iterations is {count}; expected a non-negative integer.")
        try:
            check_flags(self, "tta", "collisions")
        except ValueError as e:
            raise PhysXNetError(f"{e}.") from None
