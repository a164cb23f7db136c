"""Cloth with a static body: sheets, drapes, drops."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._advance import advance, start_state
from ._diagnostics import Rollout
from ._prepared_scene import PreparedScene
from ._scene import cast, make_system
from ._solver import Solver


def settle_on_static_body(
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
    """Simulates a scene while the body holds its rest pose.

    Args:
        scene: The prepared scene.
        frames: Number of frames after the start.
        solver: Solver of the cloth.
        fps: Frames per second.
        start: Initial cloth positions [m]; the rest shape if omitted.
        velocity: Initial cloth velocities [m/s]; zero if omitted.
        shift: Translation of the whole scene [m].
        energies: Include the energy of each effect in the diagnostics.

    Returns:
        Frames 1 and later, without the start.
    """
    assembly = scene.assembly
    body = assembly.body
    heads = np.asarray(body.joint_positions(jnp.asarray(assembly.rest_body, jnp.float32))[0])
    with jax.enable_x64(solver.precision == "float64"):
        dtype = solver.precision

        def device(x: np.ndarray) -> Array:
            return jax.device_put(np.asarray(x, dtype))

        x = assembly.rest if start is None else np.asarray(start, np.float64)
        v = np.zeros_like(x) if velocity is None else np.asarray(velocity, np.float64)
        system = make_system(scene, solver)
        position = device(x + np.asarray(shift))[:, :, None]
        state = start_state(system, position, device(v)[:, :, None], solver=solver, fps=fps)
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
        positions = np.asarray(moved)[..., 0]
        values = {k: np.asarray(q)[:, 0] for k, q in info.items()}
    garments = tuple(positions[:, i:j] for i, j in zip(assembly.parts, assembly.parts[1:]))
    return Rollout(garments, fps, values, "static body")
