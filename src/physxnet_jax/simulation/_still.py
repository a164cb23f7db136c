"""Cloth beside a body that stands still: sheets, drapes, drops."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._advance import advance, start_state
from ._diagnostics import Rollout
from ._scene import PreparedScene, cast
from ._solver import Solver


def simulate_still(
    scene: PreparedScene,
    frames: int,
    *,
    solver: Solver,
    fps: float = 30.0,
    start: Float[np.ndarray, "vertices 3"] | None = None,
    velocity: Float[np.ndarray, "vertices 3"] | None = None,
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0),
    energies: bool = False,
) -> Rollout:
    """Rolls a scene for some frames while the body stands in its rest pose.

    Args:
        scene: The scene, prepared.
        frames: Frames after the start.
        solver: How the cloth moves.
        fps: Frames a second.
        start: Cloth at the start [m]; its rest shape if omitted.
        velocity: Its velocity [m/s]; none if omitted.
        shift: Where the whole scene stands [m].
        energies: Put the energy of each effect into the diagnostics.

    Returns:
        Frames 1 and later, without the start.
    """
    assembly = scene.assembly
    body = assembly.body
    heads = np.asarray(body.joint_positions(jnp.asarray(assembly.rest_body, jnp.float32))[0])
    with jax.enable_x64(solver.precision == "float64"):
        dtype = solver.precision

        def device(x: np.ndarray) -> Array:
            return jnp.asarray(np.asarray(x, dtype))

        x = assembly.rest if start is None else np.asarray(start, np.float64)
        v = np.zeros_like(x) if velocity is None else np.asarray(velocity, np.float64)
        system = scene.system(solver)
        place = device(x + np.asarray(shift))[:, :, None]
        state = start_state(system, place, device(v)[:, :, None], solver=solver, fps=fps)
        pose = jnp.repeat(cast(body.a_pose(), dtype)[None, None], frames + 1, axis=0)
        root = np.repeat((heads[:1] + np.asarray(shift))[None], frames + 1, axis=0)
        _, moved, info = advance(
            system,
            state,
            pose,
            device(root),
            solver=solver,
            fps=fps,
            time=jnp.asarray(0.0, dtype),
            energies=energies,
        )
        every = np.asarray(moved)[..., 0]
        values = {k: np.asarray(q)[:, 0] for k, q in info.items()}
    pieces = tuple(every[:, i:j] for i, j in zip(assembly.parts, assembly.parts[1:]))
    return Rollout(pieces, fps, values, "still")
