"""A garment let down onto the body that it hangs above."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from ..body import Body
from ..errors import MeshError
from ..garment import Garment
from ..simulation import ACCURACY, Scene, prepare_scene, simulate_still, standard_effects

# Frames of 1/30 s between halts, halts at most, and what moves less in between lies still [m].
_FRAMES, _HALTS, _STILL = 10, 12, 1e-3
# What falls farther has come off [m].
_LOST = 0.25


def drape(
    garment: Garment,
    *,
    start: Float[np.ndarray, "vertices 3"] | None = None,
    body: Body | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Float[np.ndarray, "vertices 3"]:
    """Where a garment comes to lie on the body at rest, by its weight and fabric.

    Its edges keep their lengths. The cloth is brought to a halt every third of a second,
    which takes the energy out of swings, until it stays where it is or four seconds are over.

    Args:
        garment: The garment; its mesh says how long its edges are.
        start: Where it begins to fall [m]; there if omitted.
        body: The body; the built-in one by default.
        progress: Called with halts done and halts at most.

    Returns:
        Positions [m].

    Raises:
        MeshError: It falls off: nothing of it rests on the body.
        SimulationError: Cloth that can't be simulated.

    References:
        Cundall, Explicit finite-difference methods in geomechanics (1976), for bringing
        to a halt.
    """
    scene = prepare_scene(Scene((garment,), standard_effects(1), body))
    x = rest = np.asarray(garment.mesh.vertices if start is None else start, np.float64)
    for k in range(_HALTS):
        if progress is not None:
            progress(k, _HALTS)
        rollout = simulate_still(scene, _FRAMES, solver=ACCURACY["standard"], start=x)
        rollout.check()
        before, x = x, np.asarray(rollout.positions[0][-1], np.float64)
        if np.median(rest[:, 1] - x[:, 1]) > _LOST:
            raise MeshError(
                f"{garment.name}: falls off, nothing of it rests on the body. Close it about the"
                " waist or the shoulders, or wear it as it is."
            )
        if np.abs(x - before).max() < _STILL:
            break
    return x
