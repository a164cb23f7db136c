"""Elastic: bands that are shorter than the cloth they are sewn to, as at a waist."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ...errors import check_numbers
from ...typing import pytree
from .._assembly import Assembly, norm
from .._effect import Effect, Prepared, Rest
from ._colored import Colored, Constraint, Group, color_constraints, directed


@dataclasses.dataclass(frozen=True)
class Elastic(Effect):
    """``E = 1/2 sum (T / L_e) max(|x_a - x_b| - L_e, 0)^2`` along the bands of garments.

    ``L_e`` is the edge's rest length times ``1 - gathered``. A band only pulls, like rubber; its
    tension holds a garment up by the skin's friction, which bands have more of than cloth.

    Attributes:
        gathered: Share by which the band is shorter than the cloth at rest [1].
        tension: Force at twice the band's own length [N].

    References:
        The capstan: a band of tension t presses with 2 pi t in all on a round body, and holds
        what weighs less than its friction times that.
    """

    gathered: float = 0.25
    tension: float = 60.0

    def __post_init__(self) -> None:
        check_numbers(self, "tension")
        check_numbers(self, "gathered", zero=True)

    def idle(self, assembly: Assembly) -> bool:
        """Without a band."""
        return not len(assembly.bands)

    def prepare(self, assembly: Assembly, inverse_mass: Array) -> Prepared:
        """Colours the bands' edges so that a Gauss-Seidel sweep runs colour by colour."""
        edges, x = assembly.bands, assembly.rest
        length = np.linalg.norm(x[edges[:, 0]] - x[edges[:, 1]], axis=1)
        length = np.maximum(length * max(1.0 - self.gathered, 0.05), 1e-4)
        law = {"length": length, "compliance": length / self.tension}
        group = color_constraints(edges, np.asarray(inverse_mass), law)
        return _Elastic(group, max(1.0 - self.gathered, 0.05), self.tension)


@pytree
@dataclasses.dataclass(frozen=True)
class _Elastic(Colored):
    group: Group
    shorter: float = dataclasses.field(metadata={"static": True})
    tension: float = dataclasses.field(metadata={"static": True})

    def reshaped(self, rest: Rest) -> Prepared:
        a, b = (rest.cloth[i] for i in self.group.index)
        length = jnp.maximum(norm(b - a) * self.shorter, 1e-4)[:, None, None]
        law = {"length": length, "compliance": length / self.tension}
        return dataclasses.replace(self, group=self.group.reshaped(rest, law))

    def measure(self, law: Any, corners: tuple[Array, ...]) -> list[Any]:
        def excess(x: tuple[Array, ...]) -> Constraint:
            span = directed(x[1] - x[0], law["length"])
            length = jnp.sqrt(jnp.sum(span * span, axis=1, keepdims=True) + 1e-18)
            longer = jnp.maximum(length - law["length"], 0.0)
            n = jnp.where(longer > 0, span / length, 0.0)
            return Constraint(longer, (-n, n), law["compliance"])

        return [excess]
