"""Simulation of garments, as an alternative to prediction."""

import dataclasses
import math
import pathlib
import time
from collections.abc import Callable, Sequence
from typing import Literal, cast

import numpy as np
from jaxtyping import Array, Float

from ..body import Body
from ..errors import FormatError, check_counts, check_flags, check_numbers
from ..garment import Garment, refine_garment
from ..motion import Motion
from ..simulation import (
    EFFECTS,
    PRESETS,
    XPBD,
    Accuracy,
    Effect,
    Implicit,
    Rollout,
    Scene,
    Solver,
    needs_floor,
    prepare_scene,
    simulate_batch,
    standard_effects,
)
from ..simulation.blender import simulate_blender
from ..simulation.effects import Air, Bend, Damping, Dihedral, Floor, Membrane, SelfContact, Stretch
from ..simulation.newton import simulate_newton
from ._stages import Stage
from .postprocess import layer_order

EXTERNAL_ENGINES: dict[str, Callable[..., Rollout]] = {
    "blender": simulate_blender,
    "newton": simulate_newton,
}
"""Simulators that run out of process."""
_Progress = Callable[[str, int, int], None]
# Substeps of a contact interval, where their number is given.
_EACH = 64


@dataclasses.dataclass(frozen=True, kw_only=True)
class Simulation:
    """Options of the cloth simulator.

    Attributes:
        accuracy: ``draft``, ``standard``, ``fine`` or ``reference``.
        engine: ``xpbd``; ``bdf2`` (implicit, second order); ``blender`` or ``newton``, which
            run out of process (PHYSXNET_BLENDER, PHYSXNET_NEWTON).
        wind: Steady wind [m/s].
        self_contact: Whether garments collide with themselves.
        floor: Whether there is a floor, or its height [m], 0 by default; if None, there is one
            where a garment reaches down to it or the person kneels, sits or lies.
        effects: Effects that replace the standard ones.
        substeps: Steps a frame at 30 frames per second, in place of those of ``accuracy``; 8 for
            a guided simulation.
        refine: Longest edge of the garments while they are simulated [m]: coarse meshes then
            fold and lie on the body as fine ones do. The result is on their own vertices; errors
            and diagnostics are of the finer ones.
        resume: Folder that keeps finished blocks of the clip until it is complete, for all methods.
    """

    accuracy: Accuracy = "standard"
    engine: Literal["xpbd", "bdf2", "blender", "newton"] = "xpbd"
    wind: tuple[float, float, float] | None = None
    self_contact: bool = False
    floor: bool | float | None = None
    effects: tuple[Effect, ...] | None = None
    substeps: int | None = None
    refine: float | None = None
    resume: pathlib.Path | None = None

    def __post_init__(self) -> None:
        try:
            check_numbers(self, "refine")
            if self.substeps is not None:
                check_counts(self, "substeps")
            check_flags(self, "self_contact")
            # They check wind and floor.
            _ = self.also
        except ValueError as e:
            raise FormatError(f"{e}.") from None
        engines = ("xpbd", "bdf2", *EXTERNAL_ENGINES)
        if self.engine not in engines:
            raise FormatError(f"No engine '{self.engine}'; there are {', '.join(engines)}.")
        if self.accuracy not in PRESETS:
            raise FormatError(f"No accuracy '{self.accuracy}'; there are {', '.join(PRESETS)}.")
        options = {
            "accuracy": self.accuracy != "standard",
            "wind": self.wind is not None,
            "self_contact": self.self_contact,
            "floor": self.floor is not None,
            "substeps": self.substeps is not None,
        }
        given = [name for name, is_set in options.items() if is_set]
        if self.engine in EXTERNAL_ENGINES and given:
            raise FormatError(
                f"engine {self.engine} defines its own forces, contact and accuracy: leave"
                f" {', '.join(given)} out."
            )
        if self.engine == "bdf2" and (options["accuracy"] or options["substeps"]):
            raise FormatError(
                "accuracy and substeps apply to xpbd only: leave them or engine bdf2 out."
            )

    @property
    def solver(self) -> Solver:
        """The solver of ``xpbd`` and ``bdf2``, for 30 frames per second."""
        if self.engine == "bdf2":
            return Implicit(16, 4)
        if self.substeps is None:
            return PRESETS[self.accuracy]
        intervals = math.gcd(self.substeps, max(1, self.substeps // _EACH))
        return XPBD(self.substeps, intervals)

    @property
    def also(self) -> tuple[Effect, ...]:
        """Effects requested in addition to the others."""
        wind = () if self.wind is None else (Air(wind=self.wind),)
        contact = (SelfContact(),) if self.self_contact else ()
        if self.floor is None or self.floor is False:
            return (*wind, *contact)
        return (*wind, *contact, Floor(0.0 if self.floor is True else self.floor))


def build_scene(
    garments: Sequence[Garment],
    body: Body | None,
    shape: Float[Array, " shapes"] | None,
    simulation: Simulation,
    also: Sequence[Effect] = (),
) -> Scene:
    """Makes a scene of garments in layer order, with the effects that act on them.

    Args:
        garments: The garments.
        body: The body; the built-in one if None.
        shape: Shape parameters; the default shape if None.
        simulation: Defines the effects; `standard_effects` if its effects are None.
        also: Additional effects; each replaces an effect of the same type.
    """
    ordered = layer_order(garments)
    simulation = with_floor(simulation, ordered, body, shape)
    return Scene(tuple(ordered), _active_effects(simulation, ordered, also), body, shape)


def with_floor(
    simulation: Simulation,
    garments: Sequence[Garment],
    body: Body | None,
    shape: Float[Array, " shapes"] | None,
    motion: Motion | None = None,
    height: float = 0.0,
) -> Simulation:
    """Decides whether there is a floor, where the options leave it open.

    Args:
        simulation: The options.
        garments: The garments.
        body: The body; the built-in one if None.
        shape: Shape parameters; the default shape if None.
        motion: The motion, which may call for a floor; none if None.
        height: Height of its floor [m].
    """
    external = simulation.engine in EXTERNAL_ENGINES
    if simulation.floor is not None or simulation.effects is not None or external:
        return simulation
    if not needs_floor(garments, body, shape, motion, height):
        return dataclasses.replace(simulation, floor=False)
    return dataclasses.replace(simulation, floor=height or True)


def _active_effects(
    simulation: Simulation, garments: Sequence[Garment], also: Sequence[Effect] = ()
) -> tuple[Effect, ...]:
    also = (*simulation.also, *also)
    if simulation.effects is not None:
        return _merge_effects(simulation.effects, also)
    acting = standard_effects(garments)
    # Damping models still air; springs and triangles both resist stretching: one of each acts.
    others = {Air: Damping, Membrane: Stretch, Dihedral: Bend}
    replaced = tuple(old for new, old in others.items() if any(isinstance(e, new) for e in also))
    acting = tuple(e for e in acting if not isinstance(e, replaced))
    return _merge_effects(acting, also)


def run_simulation(
    scene: Scene,
    motion: Motion,
    simulation: Simulation,
    *,
    progress: _Progress | None = None,
    stages: list[Stage] | None = None,
) -> Rollout:
    """Simulates a scene through a motion.

    Args:
        scene: Garments and effects.
        motion: The body's motion.
        simulation: Engine and accuracy; its effects aren't used, those of the scene act.
        progress: Called with the stage, the frames done and the total number of frames.
        stages: List to which the time of the simulation is appended.

    Raises:
        SimulationError: The cloth isn't finite.
    """
    own = [g.num_vertices for g in scene.garments]
    if simulation.refine is not None:
        finer = tuple(refine_garment(g, simulation.refine) for g in scene.garments)
        scene = dataclasses.replace(scene, garments=finer)
    ticks, done = [time.perf_counter()], [0]

    def tick(frames: int, total: int) -> None:
        ticks.append(time.perf_counter())
        done.append(frames)
        if progress is not None:
            progress("simulation", frames, total)

    if simulation.engine in EXTERNAL_ENGINES:
        rollout = EXTERNAL_ENGINES[simulation.engine](scene, motion, progress=tick)
    else:
        solver = simulation.solver.at_rate(motion.fps)
        rollout = simulate_batch(
            prepare_scene(scene), [motion], solver=solver, progress=tick, resume=simulation.resume
        )[0]
    rollout.check()
    if simulation.refine is not None:
        rollout = dataclasses.replace(
            rollout,
            positions=tuple(x[:, :n] for x, n in zip(rollout.positions, own, strict=True)),
            vertices=sum(x.shape[1] for x in rollout.positions),
        )
    if stages is not None:
        durations = 1e3 * np.diff(ticks)
        # The first call may report frames that an earlier run finished.
        per_frame = durations[1:] / np.maximum(np.diff(done)[1:], 1)
        warm = float(np.median(per_frame)) if len(per_frame) else None
        stages.append(Stage("simulation", float(durations[0]) if len(durations) else 0.0, warm))
    return cast(Rollout, rollout)


def _merge_effects(effects: Sequence[Effect], also: Sequence[Effect]) -> tuple[Effect, ...]:
    """Merges effects in the order of `EFFECTS`; custom effects precede self-contact."""
    rank = {kind: k for k, kind in enumerate(EFFECTS.values())}
    custom = rank[SelfContact] - 0.5
    new = {type(e) for e in also}
    others = [e for e in effects if type(e) not in new]
    return tuple(sorted((*others, *also), key=lambda e: rank.get(type(e), custom)))
