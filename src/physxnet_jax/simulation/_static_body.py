"""Cloth with a static body: sheets, drapes, drops."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.spatial import KDTree

from ..body import NUM_BODY_VERTICES, triangulate
from ..geometry import closest_on_host, mesh_edges, vertex_normals
from ._advance import advance, start_state
from ._assembly import Assembly
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
        start: Initial cloth positions [m]; the rest shape if omitted. Where contact couldn't
            lift cloth out of the body (it lies deep, or past the middle of a limb), and around
            there, cloth starts where it lies at rest.
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
        contact = any(e.unilateral and e.skinned_points for e in scene.effects)
        if start is not None and contact and np.isfinite(x).all():
            x = _out_of_body(assembly, x)
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


# Contact lifts cloth that is less deep below the skin that it lay on [m].
_DEEP = 0.012
# Triangles of the skin that are compared for each vertex.
_COMPARED = 16
# Most strain between cloth that was taken out of the body and cloth that wasn't [1].
_MOST_STRAIN = 0.5


def _out_of_body(
    assembly: Assembly, start: Float[np.ndarray, "vertices 3"]
) -> Float[np.ndarray, "vertices 3"]:
    """The start, with cloth that is deep in the body, and around it, where it lies at rest."""
    skin = assembly.rest_body[:NUM_BODY_VERTICES]
    faces = np.asarray(triangulate(assembly.body.quads))
    normals, middles = vertex_normals(skin, faces), KDTree(skin[faces].mean(axis=1))

    def closest(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Closest points of the skin, and its unit normals there."""
        near = np.asarray(middles.query(points, _COMPARED)[1])
        face, weights, _ = closest_on_host(skin, faces, points, near)
        foot, normal = (np.einsum("vk,vkc->vc", weights, x[faces[face]]) for x in (skin, normals))
        return foot, normal / np.linalg.norm(normal, axis=1, keepdims=True)

    def height(points: np.ndarray, foot: np.ndarray, normal: np.ndarray) -> np.ndarray:
        return np.sum((points - foot) * normal, axis=1)

    at_rest = closest(assembly.rest)
    now, before = height(start, *closest(start)), height(assembly.rest, *at_rest)
    crossed = (now < 0) & (height(start, *at_rest) < -_DEEP)
    back = ((now < -_DEEP) | crossed) & (before > now)
    ends = mesh_edges(assembly.faces).vertices
    rest = np.linalg.norm(assembly.rest[ends[:, 0]] - assembly.rest[ends[:, 1]], axis=1)
    out, count = np.array(start), -1
    while count < int(back.sum()):
        count = int(back.sum())
        out[back] = assembly.rest[back]
        length = np.linalg.norm(out[ends[:, 0]] - out[ends[:, 1]], axis=1)
        torn = back[ends].any(axis=1) & (np.abs(length - rest) > _MOST_STRAIN * rest)
        back[ends[torn]] = True
    return out
