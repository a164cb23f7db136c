"""Scenes: garments on a body and the effects that act on them."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..body import NUM_BODY_VERTICES, Body, load_body
from ..devices import on_processor, prepared_on_processor
from ..errors import SimulationError, check_type
from ..garment import Garment
from ..motion import Motion
from ._assembly import assemble, float32
from ._effect import Effect
from ._prepared_scene import PreparedScene
from ._solver import Solver
from ._state import System
from .effects import (
    Air,
    Bend,
    BodyContact,
    Damping,
    Dihedral,
    Elastic,
    Floor,
    Gravity,
    Guide,
    LayerContact,
    Membrane,
    Pin,
    Seam,
    SelfContact,
    StrainLimit,
    Stretch,
    Tether,
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
    "elastic": Elastic,
    "guide": Guide,
    "tether": Tether,
    "strain_limit": StrainLimit,
    "self_contact": SelfContact,
    "layer_contact": LayerContact,
    "body_contact": BodyContact,
    "floor": Floor,
    "pin": Pin,
}
"""All effects by name, in the recommended order."""

STANDARD: tuple[Effect, ...] = (
    Gravity(),
    Damping(),
    Stretch(),
    Bend(),
    BodyContact(),
    Pin(),
)
"""Default effects for the clothes of a moving person, in their order of application."""


# Cloth this near to the soles of the standing body meets the floor when it walks [m].
_NEAR_FLOOR = 0.05
# Hips lower than this share of their standing height: the person kneels, sits or lies.
_LOW = 0.65


def needs_floor(
    garments: Sequence[Garment],
    body: Body | None = None,
    shape: Float[Array, " shapes"] | None = None,
    motion: Motion | None = None,
    height: float = 0.0,
) -> bool:
    """Whether a garment reaches down to the floor, or the person's hips come near to it.

    Args:
        garments: The garments.
        body: The body; the built-in one if None.
        shape: Shape parameters; the default if None.
        motion: The motion; none if None.
        height: Height of its floor [m].
    """
    body = load_body() if body is None else body
    rest = body.rest_vertices(body.default_shape() if shape is None else shape)
    soles = float(np.asarray(rest)[:NUM_BODY_VERTICES, 1].min())
    hems = (float(np.asarray(g.rest_vertices(rest))[:, 1].min()) for g in garments)
    if min(hems, default=np.inf) < soles + _NEAR_FLOOR:
        return True
    standing = float(body.joint_positions(rest)[0][0, 1]) - soles
    return motion is not None and bool(np.min(motion.root[:, 1]) < height + _LOW * standing)


def standard_effects(garments: Sequence[Garment]) -> tuple[Effect, ...]:
    """`STANDARD` and what the garments call for.

    `Membrane` in place of `Stretch` where a fabric has stiffnesses of its own along warp, weft or
    in shear, at about twice the time; `Elastic` where a garment has a band; `LayerContact` between
    several garments.
    """
    more: list[Effect] = [Elastic()] if any(g.elastic for g in garments) else []
    if len(garments) > 1:
        more.append(LayerContact())
    woven = any(g.fabric.is_directional for g in garments)
    effects = [Membrane() if woven and isinstance(e, Stretch) else e for e in STANDARD]
    at = [type(e) for e in effects].index(BodyContact)
    return (*effects[:at], *more, *effects[at:])


@dataclasses.dataclass(frozen=True)
class Scene:
    """Garments worn on a body.

    Attributes:
        garments: Garments, innermost first. With `LayerContact` each stays over the
            ones before it; without it they don't interact.
        effects: Effects, applied in this order within a substep. An effect that isn't
            listed isn't computed, nor is one that has nothing to do, as pins of nothing.
        body: The body; the built-in one if None.
        shape: Shape parameters of the body; the default if None.
    """

    garments: tuple[Garment, ...]
    effects: tuple[Effect, ...] = STANDARD
    body: Body | None = None
    shape: Float[Array, " shapes"] | None = None


def cast(tree: Any, precision: str) -> Any:
    """Casts the floating-point arrays of a pytree."""
    dtype = jnp.dtype(precision)

    def one(x: Any) -> Any:
        x = jnp.asarray(x)
        return x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x

    return jax.tree.map(one, tree)


def prepare_scene(scene: Scene) -> PreparedScene:
    """Builds everything that rollouts of a scene need.

    Raises:
        SimulationError: No garment, or the same effect twice.
    """
    check_type(scene, Scene, "Pass a Scene, as Scene((template('top'),)).")
    garments = scene.garments
    check_type(
        garments, (tuple, list), "The garments of a Scene are a tuple, as (template('top'),)."
    )
    for garment in garments:
        check_type(
            garment, Garment, "Pass garments, as template('top') or load_garment('coat.obj')."
        )
    if not scene.garments:
        raise SimulationError("A scene needs a garment; garments is empty.")
    kinds = [type(e) for e in scene.effects]
    if len(set(kinds)) != len(kinds):
        raise SimulationError(
            f"An effect is listed twice: {[k.__name__ for k in kinds]}. List each only once."
        )
    body = load_body() if scene.body is None else scene.body
    body.checked_shape(scene.shape)
    # `make_system` moves the tables to the device.
    with on_processor():
        shape = body.default_shape() if scene.shape is None else scene.shape
        assembly = assemble(scene.garments, body, shape)
        # Pinned vertices have infinite mass only if the scene has `Pin`.
        held = assembly.pinned if Pin in kinds else np.zeros_like(assembly.pinned)
        inverse = np.where(held, 0.0, 1.0 / assembly.mass)
        inverse_mass = jax.device_put(inverse.astype(np.float32))
        acting = (e for e in scene.effects if not e.idle(assembly))
        prepared = tuple(e.prepare(assembly, inverse_mass) for e in acting)
    return PreparedScene(assembly, prepared, inverse_mass[:, None, None])


@prepared_on_processor
def make_system(scene: PreparedScene, solver: Solver) -> System:
    """Moves a scene to the device, in the solver's precision."""
    system = System(
        scene.assembly.body,
        float32(scene.assembly.rest_body),
        scene.effects,
        scene.inverse_mass,
        jax.device_put(scene.assembly.faces.astype(np.int32)),
        float32(scene.assembly.density),
        solver.prepare(scene),
    )
    return cast(system, solver.precision)
