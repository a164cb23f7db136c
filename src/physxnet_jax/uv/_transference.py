"""The one type behind all of the paper's transference matrices."""

import dataclasses

from jaxtyping import Array, Bool, Float, Int

from ..geometry import interpolate
from ..typing import pytree


@pytree
@dataclasses.dataclass(frozen=True)
class Transference:
    """A sparse row-stochastic matrix: each row mixes the three corners of a face.

    ``transference @ vertices`` gives one point a row. Rows that aren't valid mix
    arbitrary vertices; mask them with ``valid``.

    Attributes:
        vertices: Indices of the three corners, shape [rows, 3].
        weights: Barycentric weights, shape [rows, 3].
        valid: Whether the row means anything, shape [rows].

    References:
        PhysXNet, equations 3, 5 and 8: T_CB, T_UB and T_BC.
    """

    vertices: Int[Array, "rows 3"]
    weights: Float[Array, "rows 3"]
    valid: Bool[Array, " rows"]

    def __matmul__(
        self, values: Float[Array, "*batch vertices channels"]
    ) -> Float[Array, "*batch rows channels"]:
        """Values at vertices carried to the rows; the unit stays."""
        return interpolate(values, self.vertices, self.weights)
