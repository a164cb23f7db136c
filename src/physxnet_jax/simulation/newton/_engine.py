"""Hands a scene to Newton and takes back the cloth."""

import dataclasses
import os
import pathlib
import shutil
from collections.abc import Callable

from ...errors import MissingDependencyError, check_counts, check_numbers
from ...motion import Motion
from .._diagnostics import Rollout
from .._outside import simulate_outside
from .._scene import Scene, prepare_scene

_SCRIPT = pathlib.Path(__file__).with_name("_script.py")


@dataclasses.dataclass(frozen=True)
class NewtonSettings:
    """Settings of Newton's vertex block descent (`SolverVBD`).

    Attributes:
        substeps: Steps a frame.
        iterations: Of the solver in each step.
        density: Of the cloth [kg/m^2].
        stretch: Both stiffnesses of its triangles [N/m].
        bend: Of its hinges [N m].
        damping: Of its triangles, relative to their stiffness [s].
        radius: Distance kept from the skin [m].
        contact: Stiffness of contact [N/m].
        friction: Coulomb's coefficient.
        self_collision: Cloth collides with itself.
    """

    substeps: int = 10
    iterations: int = 10
    density: float = 0.15
    stretch: float = 1e3
    bend: float = 1e-4
    damping: float = 1e-5
    radius: float = 0.005
    contact: float = 1e4
    friction: float = 0.3
    self_collision: bool = False

    def __post_init__(self) -> None:
        check_counts(self, "substeps", "iterations")
        check_numbers(self, "density", "stretch", "radius", "contact")
        check_numbers(self, "bend", "damping", "friction", zero=True)


def find_newton() -> list[str]:
    """The command that runs a script with Newton: the Python named by ``PHYSXNET_NEWTON``.

    Raises:
        MissingDependencyError: It isn't set, or is no program.
    """
    program = os.environ.get("PHYSXNET_NEWTON")
    if program is None or shutil.which(program) is None:
        raise MissingDependencyError(
            "No Newton: set PHYSXNET_NEWTON to a Python that has it (pip install newton, in"
            " an environment of its own)."
        )
    return [program, str(_SCRIPT)]


def simulate_newton(
    scene: Scene,
    motion: Motion,
    *,
    settings: NewtonSettings | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Rollout:
    """Simulates a scene in Newton, with the lead-in that `simulate` has.

    Effects of the scene are not looked at, only its garments, body and shape. The skin's
    triangles are moved by hand each step, between frames along straight lines.

    Args:
        scene: Garments and body.
        motion: The body's motion.
        settings: Of the solver.
        progress: Called with frames done and frames in all.

    Returns:
        Positions, and the diagnostics that `simulate_blender` gives.

    Raises:
        MissingDependencyError: No Newton.
        SimulationError: Newton failed; its last words are given.
    """
    settings = NewtonSettings() if settings is None else settings
    scene = dataclasses.replace(scene, effects=())
    return simulate_outside(
        "Newton",
        find_newton(),
        prepare_scene(scene),
        motion,
        dataclasses.asdict(settings),
        progress,
    )
