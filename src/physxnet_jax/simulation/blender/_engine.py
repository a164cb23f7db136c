"""Runs a scene in Blender and reads back the cloth."""

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
class BlenderSettings:
    """Settings of Blender's cloth modifier; the defaults are Blender's preset for cotton.

    Attributes:
        quality: Substeps per frame. At 12, 19, 23, 27, 28, 40, 50 and 60 Blender runs one
            more than requested; 5, 10, 15 and 20 are exact.
        self_collision: Whether cloth collides with itself.
        distance: Collision distance of cloth and of skin, each [m]; at least 0.001.
        tension: Stiffness of the springs, for tension, compression and shear.
        bending: Angular bending stiffness.
        damping: Damping of all springs.
        bending_damping: Damping of bending.
        air: Air drag.
        friction: Friction of the skin.
        mass: Mass of each vertex [kg] by Blender's convention: the preset's value for any
            mesh. With masses of real cloth (1e-4) its solver diverges at these stiffnesses.
    """

    quality: int = 10
    self_collision: bool = False
    distance: float = 0.005
    tension: float = 15.0
    bending: float = 0.5
    damping: float = 5.0
    bending_damping: float = 0.5
    air: float = 1.0
    friction: float = 5.0
    mass: float = 0.3

    def __post_init__(self) -> None:
        check_counts(self, "quality")
        check_numbers(self, "distance", "mass")
        check_numbers(self, "tension", "bending", "damping", zero=True)
        check_numbers(self, "bending_damping", "air", "friction", zero=True)
        if self.distance < 0.001:
            raise ValueError(f"distance is {self.distance}; Blender's minimum is 0.001 m.")


def find_blender() -> list[str]:
    """The command that runs the script in ``PHYSXNET_BLENDER`` or, if unset, ``blender``.

    ``PHYSXNET_BLENDER`` is the path of Blender, or of a Python with ``bpy`` installed.

    Raises:
        MissingDependencyError: Neither is found.
    """
    program = os.environ.get("PHYSXNET_BLENDER") or shutil.which("blender")
    if program is None or shutil.which(program) is None:
        raise MissingDependencyError(
            "Blender not found: install it, or set PHYSXNET_BLENDER to Blender or to a Python"
            " with bpy (pip install bpy, in a separate environment)."
        )
    if "blender" in pathlib.Path(program).name.lower():
        return [program, "--background", "--python-exit-code", "1", "--python", str(_SCRIPT), "--"]
    return [program, str(_SCRIPT)]


def simulate_blender(
    scene: Scene,
    motion: Motion,
    *,
    settings: BlenderSettings | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Rollout:
    """Simulates a scene in Blender, with the same warm-up as `simulate`.

    Uses the scene's garments, body and shape and ignores its effects. Garments don't
    collide with each other. Blender's model is a different one (springs with their own
    units), so its result shows another cloth and doesn't validate that of `simulate`.

    Args:
        scene: Garments and body.
        motion: The body's motion.
        settings: Settings of the cloth modifier.
        progress: Called with the number of frames done and the total.

    Returns:
        Positions, and the diagnostics ``finite``, ``speed_max``, ``worst_vertex``,
        ``residual_p99`` (zero: Blender reports none), ``penetration_max`` and
        ``milliseconds`` of each frame.

    Raises:
        MissingDependencyError: Blender isn't found.
        SimulationError: Blender failed; the message ends with its last output.
    """
    settings = BlenderSettings() if settings is None else settings
    scene = dataclasses.replace(scene, effects=())
    return run_external_engine(
        "Blender",
        find_blender(),
        prepare_scene(scene),
        motion,
        dataclasses.asdict(settings),
        progress,
    )
