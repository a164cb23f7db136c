"""Guided simulation: a few substeps of the real mesh, drawn to what the network predicts."""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..body import Body
from ..errors import PhysXNetError
from ..garment import SkinnedGarment, skin_garment
from ..simulation import (
    Effect,
    PosedPoints,
    Solver,
    State,
    System,
    advance_frame,
    make_system,
    prepare_scene,
    skin_effects,
    start_state,
)
from ..simulation.effects import BodyContact, Guide, LayerContact, PreparedGuide, Tether
from ..typing import pytree
from ._inference import Inference
from ._simulate import Simulation, build_scene
from .postprocess import (
    BodyCollider,
    Layer,
    Outfit,
    StrainLimits,
    apply_contacts,
    apply_strain,
    prepare_collisions,
    prepare_layers,
    prepare_strain,
    reshape_colliders,
    reshape_strain,
)

Posed = tuple[Float[Array, "_ 3"], ...]
"""Vertices of each garment in one frame [m]."""

# Substeps a frame at 30 frames per second, if none are given.
_SUBSTEPS = 8
# Substeps a frame at which bending needs no correction.
_CONVERGED = 128
# Rate for which a scene is prepared [1/s]; for others it is prepared again within the call.
_RATE = 30.0
# Time constant of the guide for each substep a frame, and at most [s]: with a longer one trousers
# slide down.
_TIME_CONSTANT, _LONGEST = 0.0025, 0.02
# Distance between the middles of patches [m]: nearer ones pass on the network's own noise.
_SPACING = 0.12
# Iterations of strain limiting of the first frame.
_STRAIN = 32
# Distance of a patch from its prediction at which the cloth starts anew [m].
_ASTRAY = 0.4


@pytree
@dataclasses.dataclass(frozen=True, kw_only=True)
class GuidedScene:
    """What simulates the garments of a dresser.

    Attributes:
        system: The scene, with tables for substeps at ``_RATE``.
        solver: Its solver at 30 frames per second.
        order: Place of each of the scene's garments among the dresser's.
        parts: First vertex of each of the scene's garments, and the number of vertices.
        strain: Strain limits of each garment, for the first frame.
        colliders: The skin near each garment, for the first frame.
        layers: Pairs of garments whose order is enforced there.
    """

    system: System
    solver: Solver = dataclasses.field(metadata={"static": True})
    order: tuple[int, ...] = dataclasses.field(metadata={"static": True})
    parts: tuple[int, ...] = dataclasses.field(metadata={"static": True})
    strain: StrainLimits
    colliders: tuple[BodyCollider, ...] | None
    layers: tuple[Layer, ...] | None

    @property
    def guide(self) -> PreparedGuide:
        """The effect that draws the cloth."""
        return next(e for e in self.system.effects if isinstance(e, PreparedGuide))

    def with_system(self, system: System) -> "GuidedScene":
        """The scene with changed materials or rest shapes."""
        h = 1.0 / (_RATE * self.solver.substeps)
        return dataclasses.replace(self, system=self.solver.at_step(system, h))

    def joined(self, cloth: Posed) -> Float[Array, "vertices 3 1"]:
        """All garments in the scene's order, from those of the dresser."""
        return jnp.concatenate([cloth[k] for k in self.order])[:, :, None]

    def parted(self, position: Float[Array, "vertices 3 1"]) -> Posed:
        """The dresser's garments, from the scene's."""
        out = dict(zip(self.order, jnp.split(position[:, :, 0], self.parts[1:-1]), strict=True))
        return tuple(out[k] for k in range(len(self.order)))


@pytree
@dataclasses.dataclass(frozen=True, kw_only=True)
class GuidedState:
    """The simulated cloth between two frames.

    Attributes:
        cloth: Its state.
        skin: What the effects need of the skin, see `skin_effects`.
        means: Where the patches were drawn to [m], shape [patches, 3, 1].
        rotations: World rotations of joints.
        translations: World translations of joints [m].
        time: Time since the first frame [s].
        ready: Whether there is cloth to go on from; else it starts near the prediction.
    """

    cloth: State
    skin: tuple[PosedPoints | None, ...]
    means: Float[Array, "patches 3 1"]
    rotations: Float[Array, "joints 3 3"]
    translations: Float[Array, "joints 3"]
    time: Float[Array, ""]
    ready: Bool[Array, ""]


def prepare_guided(
    outfit: Outfit,
    shape: Float[Array, " shapes"] | None,
    simulation: Simulation,
) -> GuidedScene:
    """Prepares the simulation of garments for frames at 30 a second.

    Args:
        outfit: The dresser's garments.
        shape: Shape parameters of the body; the default if None.
        simulation: Effects, and ``substeps``.

    Raises:
        PhysXNetError: Options that a guided simulation hasn't.
    """
    for name in ("accuracy", "engine", "refine"):
        value = getattr(simulation, name)
        if value != getattr(Simulation(), name):
            raise PhysXNetError(
                f"{name} is {value}, but a guided simulation has substeps and effects alone."
            )
    substeps = simulation.substeps or _SUBSTEPS
    solver = dataclasses.replace(simulation, substeps=substeps).solver
    given = [e for e in simulation.effects or () if isinstance(e, Guide)]
    guide = given or [
        Guide(spacing=_SPACING, time_constant=min(_TIME_CONSTANT * substeps, _LONGEST))
    ]
    # Effects that are given are taken as they are.
    more = (Tether(), *_contact(len(outfit.garments))) if simulation.effects is None else ()
    strain = prepare_strain(outfit, Inference(strain_iterations=_STRAIN))
    assert strain is not None
    scene = build_scene(outfit.garments, outfit.body, shape, simulation, (*guide, *more))
    places = {id(g): k for k, g in enumerate(outfit.garments)}
    prepared = prepare_scene(scene)
    system = _softened(make_system(prepared, solver), _softness(substeps * _RATE))
    return GuidedScene(
        system=solver.at_step(system, 1.0 / (_RATE * substeps)),
        solver=solver,
        order=tuple(places[id(g)] for g in scene.garments),
        parts=prepared.assembly.parts,
        strain=strain,
        colliders=prepare_collisions(outfit, Inference()),
        layers=prepare_layers(outfit, Inference()),
    )


def reshape_guided(
    scene: GuidedScene,
    body: Body,
    rest: Float[Array, "all 3"],
    worn: tuple[SkinnedGarment, ...],
) -> GuidedScene:
    """The scene for a body and garments of other rest shapes; pure, see `System.reshaped`.

    Args:
        scene: From `prepare_guided`.
        body: The body.
        rest: Its rest vertices [m].
        worn: The dresser's garments with their rest vertices.
    """
    cloth = scene.joined(tuple(w.rest for w in worn))[:, :, 0]
    return dataclasses.replace(
        scene.with_system(scene.system.reshaped(cloth, rest)),
        strain=reshape_strain(scene.strain, worn),
        colliders=scene.colliders and reshape_colliders(scene.colliders, body, rest),
    )


def _contact(garments: int) -> tuple[Effect, ...]:
    """Contact that searches less far than a simulation's: the network keeps cloth near."""
    body = BodyContact(centres=32, spacing=0.045, patch=8)
    return (body, LayerContact(hops=1, ring=10, patch=6)) if garments > 1 else (body,)


def _softness(rate: float) -> float:
    """Factor of bending for a number of substeps a second.

    One sweep a substep leaves cloth too soft along its surface, but not in bending: where substeps
    are few, the folds that it should throw are ironed out.
    """
    return min(1.0, rate / (_RATE * _CONVERGED))


def _softened(system: System, factor: float) -> System:
    bends = any("bend" in e.materials for e in system.effects)
    return system.rescaled(bend=factor) if bends else system


def init_guided(
    scene: GuidedScene,
    rotations: Float[Array, "joints 3 3"],
    translations: Float[Array, "joints 3"],
) -> GuidedState:
    """The state before the first frame, whose cloth is skinned and moved towards the prediction.

    Args:
        scene: From `prepare_guided`.
        rotations: World rotations of joints in the frame before.
        translations: World translations of joints in the frame before [m].
    """
    dtype = scene.system.inverse_mass.dtype
    zero = jnp.zeros((scene.parts[-1], 3, 1), dtype)
    skin = skin_effects(scene.system, rotations[None], translations[None])
    return GuidedState(
        cloth=start_state(scene.system, zero, solver=scene.solver, fps=_RATE),
        skin=skin,
        means=scene.guide.means(zero),
        rotations=rotations,
        translations=translations,
        time=jnp.zeros((), dtype),
        ready=jnp.zeros((), bool),
    )


def move_guided(state: GuidedState, by: Float[Array, "3"]) -> GuidedState:
    """The state displaced [m]."""
    column = by[None, :, None]
    skin = (s and dataclasses.replace(s, points=s.points + column) for s in state.skin)
    return dataclasses.replace(
        state,
        cloth=dataclasses.replace(state.cloth, position=state.cloth.position + column),
        skin=tuple(skin),
        means=state.means + column,
        translations=state.translations + by[None],
    )


def advance_guided(
    scene: GuidedScene,
    worn: tuple[SkinnedGarment, ...],
    state: GuidedState,
    predicted: Posed,
    rotations: Float[Array, "joints 3 3"],
    translations: Float[Array, "joints 3"],
    fps: float,
) -> tuple[GuidedState, Posed]:
    """Simulates the garments up to the next frame, drawn to where they are predicted.

    Cloth that isn't finite or that has gone astray starts anew from the prediction.

    Args:
        scene: From `prepare_guided`.
        worn: The dresser's garments.
        state: From `init_guided` or the frame before.
        predicted: Predicted garments [m].
        rotations: World rotations of joints.
        translations: World translations of joints [m].
        fps: Frames per second.
    """
    solver, system = scene.solver.at_rate(fps), scene.system
    if fps != _RATE:
        known, rate = (s.substeps * f for s, f in ((scene.solver, _RATE), (solver, fps)))
        system = _softened(system, _softness(rate) / _softness(known))
        system = solver.at_step(system, 1.0 / rate)
    target = scene.joined(predicted)
    means = scene.guide.lengthened(scene.guide.means(target))
    skin = skin_effects(system, rotations[None], translations[None])

    def go(_: None) -> State:
        return advance_frame(
            system,
            state.cloth,
            state.skin,
            skin,
            solver=solver,
            fps=fps,
            time=state.time,
            guide=(state.means, means),
            diagnose=False,
        )[0]

    def drawn(x: Array) -> Array:
        """Cloth moved so that its patches lie where they are predicted.

        Those that hang mostly sideways: raised to a prediction, they would crumple.
        """
        moves = means - scene.guide.means(x)
        return x + scene.guide.spread(moves.at[:, 1].set(scene.guide.held(moves)[:, 1]))

    def start(_: None) -> State:
        # Skinned cloth, whose patches lie where they are predicted: a prediction's own hems are
        # ragged. As fast as its skinning.
        skinned, before = (
            scene.joined(tuple(skin_garment(w, r, t) for w in worn))
            for r, t in ((rotations, translations), (state.rotations, state.translations))
        )
        at = rotations[None], translations[None]
        place = drawn(skinned)
        # Without slits where legs tear skinned cloth apart, and outside the skin: what begins
        # within shows for many frames.
        cloth = tuple(x[None] for x in scene.parted(place))
        cloth = apply_strain(scene.strain, cloth, *at)
        place = drawn(scene.joined(tuple(x[0] for x in cloth)))
        cloth = tuple(x[None] for x in scene.parted(place))
        cloth = apply_contacts(scene.colliders, scene.layers, cloth, *at)
        place = scene.joined(tuple(x[0] for x in cloth))
        begun = start_state(system, place, fps * (skinned - before), solver=solver, fps=fps)
        # Both branches must have one type: `start_state` gives weak ones.
        return jax.tree.map(lambda a, b: jnp.asarray(a, b.dtype), begun, state.cloth)

    cloth = jax.lax.cond(state.ready, go, start, None)
    away = jnp.sum((scene.guide.means(cloth.position) - means) ** 2, axis=1)
    new = GuidedState(
        cloth=cloth,
        skin=skin,
        means=means,
        rotations=rotations,
        translations=translations,
        time=state.time + 1.0 / fps,
        # False as well where something isn't finite.
        ready=jnp.all(away < _ASTRAY**2) & jnp.all(jnp.isfinite(cloth.velocity)),
    )
    return new, scene.parted(cloth.position)
