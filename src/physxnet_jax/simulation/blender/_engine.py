"""Hands a scene to Blender and takes back the cloth."""

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
class BlenderSettings:
    """Settings of Blender's cloth modifier: its own preset for cotton.

    Attributes:
        quality: Substeps a frame. At 12, 19, 23, 27, 28, 40, 50 and 60 Blender's loop runs
            one more than asked for; 5, 10, 15 and 20 are right.
        self_collision: Cloth collides with itself.
        distance: Collision distance of cloth and of skin, each [m]; at least 0.001.
        tension: Stiffness of springs; shear and compression are the same.
        bending: Angular bending stiffness.
        damping: Of all springs.
        bending_damping: Of bending.
        air: Drag of the air.
        friction: Of the skin.
        mass: Of every vertex [kg], as Blender counts it: the preset's value, whatever the
            mesh. Masses of real cloth (1e-4) make its solver burst at these stiffnesses.
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
            raise ValueError(f"distance is {self.distance}; Blender's least is 0.001 m.")


def find_blender() -> list[str]:
    """The command that runs a script in Blender: ``PHYSXNET_BLENDER``, or ``blender``.

    ``PHYSXNET_BLENDER`` names a Blender, or a Python that has ``bpy`` installed.

    Raises:
        MissingDependencyError: There is neither.
    """
    program = os.environ.get("PHYSXNET_BLENDER") or shutil.which("blender")
    if program is None or shutil.which(program) is None:
        raise MissingDependencyError(
            "No Blender: install it, or set PHYSXNET_BLENDER to a Blender or to a Python"
            " that has bpy (pip install bpy, in an environment of its own)."
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
    """Simulates a scene in Blender, with the lead-in that `simulate` has.

    Garments don't touch each other; effects of the scene are not looked at, only its
    garments, body and shape. Blender's model differs from ours (springs of its own
    units), so its answer is another cloth's, not a check of ours.

    Args:
        scene: Garments and body.
        motion: The body's motion.
        settings: Of the cloth modifier.
        progress: Called with frames done and frames in all.

    Returns:
        Positions, and as diagnostics ``finite``, ``speed_max``, ``worst_vertex``,
        ``residual_p99`` (zero: Blender gives none) and ``milliseconds`` of each frame.

    Raises:
        MissingDependencyError: No Blender.
        SimulationError: Blender failed; its last words are given.
    """
    settings = BlenderSettings() if settings is None else settings
    scene = dataclasses.replace(scene, effects=())
    return simulate_outside(
        "Blender",
        find_blender(),
        prepare_scene(scene),
        motion,
        dataclasses.asdict(settings),
        progress,
    )
