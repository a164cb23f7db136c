"""The type of all of the paper's transference matrices."""

import dataclasses

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..geometry import interpolate
from ..typing import pytree


@pytree
@dataclasses.dataclass(frozen=True)
class Transference:
    """A sparse row-stochastic matrix: each row mixes the three corners of a face.

    ``transference @ vertices`` gives one point per row. Invalid rows mix arbitrary
    vertices; mask them with ``valid``.

    Attributes:
        vertices: Indices of the three corners, shape [rows, 3].
        weights: Barycentric weights, shape [rows, 3].
        valid: Whether the row is meaningful, shape [rows].
        columns: Number of vertices that it mixes.

    References:
        PhysXNet, equations 3, 5 and 8: T_CB, T_UB and T_BC.
    """

    vertices: Int[Array, "rows 3"]
    weights: Float[Array, "rows 3"]
    valid: Bool[Array, " rows"]
    columns: int = dataclasses.field(metadata={"static": True})

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.vertices.shape[-2], self.columns

    def todense(self) -> Float[Array, "rows columns"]:
        """The dense matrix.

        Example:
            >>> corners, weights = jnp.asarray([[0, 1, 2]]), jnp.asarray([[0.5, 0.25, 0.25]])
            >>> Transference(corners, weights, jnp.asarray([True]), 4).todense().tolist()
            [[0.5, 0.25, 0.25, 0.0]]
        """
        dense = jnp.zeros(self.shape, self.weights.dtype)
        rows = jnp.arange(self.shape[0])[:, None]
        return dense.at[rows, self.vertices].add(self.weights)

    def __matmul__(
        self, values: Float[Array, "*batch vertices channels"]
    ) -> Float[Array, "*batch rows channels"]:
        """Interpolates vertex values at the rows, in the same unit."""
        return interpolate(values, self.vertices, self.weights)
