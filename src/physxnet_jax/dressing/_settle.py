"""Settles a garment onto the body by simulation."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from ..body import Body
from ..errors import MeshError
from ..garment import Garment
from ..simulation import PRESETS, Scene, prepare_scene, settle_on_static_body, standard_effects

# Frames of 1/30 s per interval, largest number of intervals, motion in one that is rest [m].
_FRAMES, _MAX_INTERVALS, _REST_MOTION = 10, 12, 1e-3
# Median drop above which a garment has fallen off [m].
_MAX_DROP = 0.25


def settle_on_body(
    garment: Garment,
    *,
    start: Float[np.ndarray, "vertices 3"] | None = None,
    body: Body | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Float[np.ndarray, "vertices 3"]:
    """Settles a garment on the body at rest, by its weight and fabric.

    Edges keep their rest lengths. Velocities are reset every third of a second, which removes
    the energy of swings, until the cloth is at rest or four seconds have passed.

    Args:
        garment: The garment; its mesh defines the rest lengths of edges.
        start: Initial positions [m]; those of the mesh if omitted.
        body: The body; the built-in one by default.
        progress: Called with the number of finished intervals and their largest number.

    Returns:
        Positions [m].

    Raises:
        MeshError: The garment falls off the body.
        SimulationError: The cloth can't be simulated.

    References:
        Cundall, Explicit finite-difference methods in geomechanics (1976), for the velocity
        resets.
    """
    scene = prepare_scene(Scene((garment,), standard_effects((garment,)), body))
    x = rest = np.asarray(garment.mesh.vertices if start is None else start, np.float64)
    for k in range(_MAX_INTERVALS):
        if progress is not None:
            progress(k, _MAX_INTERVALS)
        rollout = settle_on_static_body(scene, _FRAMES, solver=PRESETS["standard"], start=x)
        rollout.check()
        before, x = x, np.asarray(rollout.positions[0][-1], np.float64)
        if np.median(rest[:, 1] - x[:, 1]) > _MAX_DROP:
            raise MeshError(
                f"{garment.name}: falls off, nothing of it rests on the body. Close it about the"
                " waist or the shoulders, or wear it as it is."
            )
        if np.abs(x - before).max() < _REST_MOTION:
            break
    return x
