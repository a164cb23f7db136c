"""Scenes prepared for simulation."""

import dataclasses

from jaxtyping import Array, Float

from ._assembly import Assembly
from ._effect import Prepared


@dataclasses.dataclass(frozen=True)
class PreparedScene:
    """A scene prepared for simulation: host tables and device arrays.

    Attributes:
        assembly: Garments as one set of particles, on the host.
        effects: Prepared effects.
        inverse_mass: Inverse masses [1/kg], 0 for held vertices, shape [vertices, 1, 1].
    """

    assembly: Assembly
    effects: tuple[Prepared, ...]
    inverse_mass: Float[Array, "vertices 1 1"]
