"""Runs a scene in Newton and reads back the cloth."""

import dataclasses
import os
import pathlib
import shutil
from collections.abc import Callable

from ...errors import MissingDependencyError, check_counts, check_numbers
from ...motion import Motion
from .._diagnostics import Rollout
from .._external_engine import run_external_engine
from .._scene import Scene, prepare_scene

_SCRIPT = pathlib.Path(__file__).with_name("_script.py")


@dataclasses.dataclass(frozen=True)
class NewtonSettings:
    """Settings of Newton's vertex block descent (`SolverVBD`).

    Attributes:
        substeps: Steps per frame.
        iterations: Solver iterations per step.
        density: Density of the cloth [kg/m^2].
        stretch: Stiffness of the triangles, for ``tri_ke`` and ``tri_ka`` [N/m].
        bend: Stiffness of the hinges [N m].
        damping: Damping of triangles and hinges, relative to their stiffness [s].
        radius: Distance kept from the skin [m].
        contact: Stiffness of contact [N/m].
        friction: Coulomb coefficient [1].
        self_collision: Whether cloth collides with itself.
        contacts: Capacity of the contact buffer, in contacts per vertex; more are dropped.
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
    contacts: int = 8

    def __post_init__(self) -> None:
        check_counts(self, "substeps", "iterations", "contacts")
        check_numbers(self, "density", "stretch", "radius", "contact")
        check_numbers(self, "bend", "damping", "friction", zero=True)


def find_newton() -> list[str]:
    """The command that runs the script with the Python in ``PHYSXNET_NEWTON``.

    Raises:
        MissingDependencyError: The variable isn't set, or names no executable.
    """
    program = os.environ.get("PHYSXNET_NEWTON")
    if program is None or shutil.which(program) is None:
        raise MissingDependencyError(
            "Newton not found: set PHYSXNET_NEWTON to a Python with Newton (pip install newton,"
            " in a separate environment)."
        )
    return [program, str(_SCRIPT)]


def simulate_newton(
    scene: Scene,
    motion: Motion,
    *,
    settings: NewtonSettings | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Rollout:
    """Simulates a scene in Newton, with the same warm-up as `simulate`.

    Uses the scene's garments, body and shape and ignores its effects. The skin's
    triangles are updated in each substep, with linear interpolation between frames.

    Args:
        scene: Garments and body.
        motion: The body's motion.
        settings: Settings of the solver.
        progress: Called with the number of frames done and the total.

    Returns:
        Positions, and the same diagnostics as `simulate_blender`.

    Raises:
        MissingDependencyError: Newton isn't found.
        SimulationError: Newton failed; the message ends with its last output.
    """
    settings = NewtonSettings() if settings is None else settings
    scene = dataclasses.replace(scene, effects=())
    return run_external_engine(
        "Newton",
        find_newton(),
        prepare_scene(scene),
        motion,
        dataclasses.asdict(settings),
        progress,
    )
