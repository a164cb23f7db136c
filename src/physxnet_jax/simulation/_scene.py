"""Scenes: garments on a body, and the effects that act."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..body import Body, load_body
from ..errors import SimulationError
from ..garment import Garment
from ._assembly import Assembly, assemble, float32
from ._effect import Effect, Prepared
from ._solver import Solver
from ._state import System
from .effects import (
    Air,
    Bend,
    BodyContact,
    Damping,
    Dihedral,
    Gravity,
    LayerContact,
    Membrane,
    Pin,
    Seam,
    SelfContact,
    StrainLimit,
    Stretch,
)

EFFECTS: dict[str, type[Effect]] = {
    "gravity": Gravity,
    "damping": Damping,
    "air": Air,
    "stretch": Stretch,
    "membrane": Membrane,
    "bend": Bend,
    "dihedral": Dihedral,
    "seam": Seam,
    "strain_limit": StrainLimit,
    "self_contact": SelfContact,
    "layer_contact": LayerContact,
    "body_contact": BodyContact,
    "pin": Pin,
}
"""Every effect by name, in the order in which they are best applied."""

STANDARD: tuple[Effect, ...] = (
    Gravity(),
    Damping(),
    Stretch(),
    Bend(),
    BodyContact(),
    Pin(),
)
"""What clothes on a moving person call for, in the order they are applied."""


def standard_effects(garments: int) -> tuple[Effect, ...]:
    """`STANDARD`, and contact between layers if more than one garment is worn."""
    if garments < 2:
        return STANDARD
    at = [type(e) for e in STANDARD].index(BodyContact)
    return (*STANDARD[:at], LayerContact(), *STANDARD[at:])


@dataclasses.dataclass(frozen=True)
class Scene:
    """Garments worn on a body.

    Attributes:
        garments: What is worn, the innermost first: with `LayerContact` each stays
            over the ones before it, without it they don't touch.
        effects: What acts, in this order within a substep. An effect that isn't
            listed isn't computed.
        body: The body; the built-in one if None.
        shape: Its shape parameters; the default if None.
    """

    garments: tuple[Garment, ...]
    effects: tuple[Effect, ...] = STANDARD
    body: Body | None = None
    shape: Float[Array, " shapes"] | None = None


@dataclasses.dataclass(frozen=True)
class PreparedScene:
    """A scene ready to roll: host tables and device arrays.

    Attributes:
        assembly: Garments as one set of particles, on the host.
        effects: Prepared effects.
        inverse_mass: [1/kg], 0 where held, shape [vertices, 1, 1].
    """

    assembly: Assembly
    effects: tuple[Prepared, ...]
    inverse_mass: Float[Array, "vertices 1 1"]

    def system(self, solver: Solver) -> System:
        """The scene on the device, in the solver's precision."""
        system = System(
            self.assembly.body,
            float32(self.assembly.rest_body),
            self.effects,
            self.inverse_mass,
            solver.prepare(self),
        )
        return cast(system, solver.precision)


def cast(tree: Any, precision: str) -> Any:
    """Floating arrays of a pytree in another precision."""
    dtype = jnp.dtype(precision)

    def one(x: Any) -> Any:
        x = jnp.asarray(x)
        return x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x

    return jax.tree.map(one, tree)


def prepare_scene(scene: Scene) -> PreparedScene:
    """Builds everything a rollout needs, once.

    Raises:
        SimulationError: No garment, or the same effect twice.
    """
    if not scene.garments:
        raise SimulationError("A scene needs a garment; garments is empty.")
    kinds = [type(e) for e in scene.effects]
    if len(set(kinds)) != len(kinds):
        raise SimulationError(
            f"An effect is listed twice: {[k.__name__ for k in kinds]}. List each once."
        )
    body = load_body() if scene.body is None else scene.body
    shape = body.default_shape() if scene.shape is None else scene.shape
    assembly = assemble(scene.garments, body, shape)
    # Pinned vertices weigh infinitely much only where something pins them.
    held = assembly.pinned if Pin in kinds else np.zeros_like(assembly.pinned)
    inverse = np.where(held, 0.0, 1.0 / assembly.mass)
    inverse_mass = jnp.asarray(inverse.astype(np.float32))
    prepared = tuple(e.prepare(assembly, inverse_mass) for e in scene.effects)
    return PreparedScene(assembly, prepared, inverse_mass[:, None, None])
