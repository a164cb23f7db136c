"""What moves, and what it is moved by."""

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..body import Body, blend_rotations
from ..errors import SimulationError
from ..typing import pytree
from ._effect import Attached, Placed, Prepared

# As where the body itself is skinned.
_EXACT = jax.lax.Precision.HIGHEST


@pytree
@dataclasses.dataclass(frozen=True)
class State:
    """Cloth in motion.

    Attributes:
        position: Positions [m], shape [vertices, 3, batch].
        velocity: Velocities [m/s], shape [vertices, 3, batch].
        memory: What the solver remembers of earlier steps, see `Solver.remember`.
        kept: What each effect remembers; None at the start, see `Prepared.initial`.
    """

    position: Float[Array, "vertices 3 batch"]
    velocity: Float[Array, "vertices 3 batch"]
    memory: Any = ()
    kept: Any = None


@pytree
@dataclasses.dataclass(frozen=True)
class System:
    """A scene on the device.

    Attributes:
        body: The body.
        rest: Its rest vertices [m], shape [all, 3].
        effects: Prepared effects, in the order in which they act.
        inverse_mass: [1/kg], 0 where held, shape [vertices, 1, 1].
        extra: What the solver prepared, see `Solver.prepare`.
    """

    body: Body
    rest: Float[Array, "all 3"]
    effects: tuple[Prepared, ...]
    inverse_mass: Float[Array, "vertices 1 1"]
    extra: Any = None

    def rescaled(self, **factors: Float[Array, ""] | float) -> "System":
        """The scene with other materials, differentiable by the factors.

        Args:
            **factors: What each parameter is multiplied by: ``stretch``, ``bend``
                (stiffnesses), ``friction`` (on the skin).

        Raises:
            SimulationError: Another parameter, one that no effect of the scene has, or a
                factor that is no positive number (for friction: below zero).

        Example:
            ``jax.grad(lambda k: loss(system.rescaled(bend=k)))``
        """
        names = {"stretch", "bend", "friction"}
        if set(factors) - names:
            raise SimulationError(
                f"No parameter {', '.join(sorted(set(factors) - names))}; there are"
                f" {', '.join(sorted(names))}."
            )
        for name in factors:
            if not any(name in e.materials for e in self.effects):
                raise SimulationError(
                    f"No effect of this scene has {name}, so a factor of it changes nothing. Leave"
                    " it out, or put the effect in."
                )
        for name, factor in factors.items():
            _check_factor(name, factor)
        effects = tuple(e.rescaled(factors) for e in self.effects)
        # What a solver keeps of materials changes with them.
        extra = self.extra.rescaled(effects) if hasattr(self.extra, "rescaled") else self.extra
        return dataclasses.replace(self, effects=effects, extra=extra)


def _check_factor(name: str, factor: Any) -> None:
    """Fails where a factor that is known means nothing; a stiffness of nothing has no slope."""
    try:
        known = float(factor)
    # Of what is traced nothing is known yet.
    except jax.errors.ConcretizationTypeError:
        return
    least = 0.0 if name == "friction" else 1e-9
    if not least <= known < math.inf:
        wanted = "a number from 0 up" if name == "friction" else "a positive number"
        raise SimulationError(f"{name} is {known}, expected {wanted}, or leave the effect out.")


def place(
    body: Body,
    rest: Float[Array, "all 3"],
    attached: Attached,
    rotations: Float[Array, "batch joints 4"],
    root: Float[Array, "batch 3"],
) -> Placed:
    """Attached points skinned with the body in a batch of poses."""

    def one(q: Array, p: Array) -> tuple[Array, Array]:
        world, shift = body.transforms(rest, q, p)
        blend = blend_rotations(attached.weights, world)
        points = jnp.einsum("vab,vb->va", blend, attached.rest, precision=_EXACT)
        points = points + jnp.matmul(attached.weights, shift, precision=_EXACT)
        return points, jnp.einsum("vab,vb->va", blend, attached.normals, precision=_EXACT)

    points, normals = jax.vmap(one, out_axes=2)(rotations, root)
    return Placed(points, normals)
