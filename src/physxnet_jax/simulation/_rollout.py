"""Rollouts: a scene through a motion, from rest, frame by frame."""

import dataclasses
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation, Slerp

from ..body import Body
from ..errors import SimulationError
from ..motion import Motion, animate
from ._assembly import float32
from ._scene import PreparedScene, Scene, prepare_scene
from ._xpbd import XPBD, State, advance

# Frames compiled together: clips of any length are cut into blocks of this many.
_BLOCK = 10


@dataclasses.dataclass(frozen=True)
class Rollout:
    """What a rollout gives.

    Attributes:
        positions: Cloth positions of every garment [m], shapes [frames, vertices, 3].
        fps: Frames a second.
        diagnostics: Values of each frame: ``finite``, ``speed_max`` [m/s], and what
            the scene's effects add: ``strain_max``, ``strain_p99`` [1],
            ``penetration_max`` [m], ``inside_share`` [1].
    """

    positions: tuple[Float[np.ndarray, "frames vertices 3"], ...]
    fps: float
    diagnostics: dict[str, np.ndarray]

    @property
    def finite(self) -> Bool[np.ndarray, " frames"]:
        """Which frames hold no NaN and no infinity."""
        return self.diagnostics["finite"].astype(bool)


def lead_in(body: Body, motion: Motion, *, seconds: float = 1.5, settle: float = 0.4) -> Motion:
    """Frames that lead from the rest pose smoothly into a clip's first frame.

    The body stands at the clip's place with its heading, holds the rest pose while the
    cloth settles, then eases into the first pose.

    Args:
        body: The body.
        motion: The clip.
        seconds: Length of the lead-in [s].
        settle: Part of it in which the body stands still [s].

    Returns:
        The lead-in alone; its last frame is the clip's first.
    """
    frames = max(2, round(seconds * motion.fps))
    t = np.arange(1, frames + 1) / frames
    hold = min(settle / seconds, 0.9)
    s = np.clip((t - hold) / (1 - hold), 0.0, 1.0)
    s = s**3 * (10 - 15 * s + 6 * s * s)
    first = np.asarray(motion.rotations[0], dtype=np.float64)
    rest = np.asarray(body.a_pose(), dtype=np.float64)
    forward = Rotation.from_quat(first[0], scalar_first=True).apply([0.0, 0.0, 1.0])
    yaw = np.arctan2(forward[0], forward[2])
    rest[0] = Rotation.from_euler("Y", yaw).as_quat(scalar_first=True)
    rotations = np.empty((frames, *first.shape))
    for j in range(len(first)):
        pair = Rotation.from_quat(np.stack([rest[j], first[j]]), scalar_first=True)
        rotations[:, j] = Slerp([0.0, 1.0], pair)(s).as_quat(scalar_first=True)
    root = np.repeat(np.asarray(motion.root[:1]), frames, axis=0)
    return Motion(float32(rotations), jnp.asarray(root), motion.fps, f"{motion.name} lead-in")


def simulate(
    scene: Scene,
    motion: Motion,
    *,
    solver: XPBD | None = None,
    progress: Callable[[int, int], None] | None = None,
    throw: bool = True,
) -> Rollout:
    """Simulates a scene through a motion.

    Args:
        scene: Garments, body and effects.
        motion: The body's motion.
        solver: Substeps and queries; `XPBD` by default.
        progress: Called with frames done and frames in all.
        throw: Raise if a frame isn't finite; otherwise the flag is in the result.

    Returns:
        Positions of each garment in every frame, and diagnostics. The lead-in from
        the rest pose is simulated and left out.

    Raises:
        SimulationError: A frame that isn't finite (its number is named).
    """
    results = simulate_batch(prepare_scene(scene), [motion], solver=solver, progress=progress)
    out = results[0]
    if throw and not out.finite.all():
        frame = int(np.argmin(out.finite))
        raise SimulationError(
            f"{motion.name}: frame {frame} is not finite. Try more substeps; look for"
            " a teleport in the motion or degenerate triangles in the garment."
        )
    return out


def simulate_batch(
    scene: PreparedScene,
    motions: list[Motion],
    *,
    solver: XPBD | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[Rollout]:
    """Several motions side by side; each result is cut to its motion's length.

    Args:
        scene: The scene, prepared.
        motions: Clips of one frame rate. Shorter ones hold their last pose.
        solver: Substeps and queries.
        progress: Called with frames done and frames in all.

    Returns:
        One rollout a motion.

    Raises:
        SimulationError: Motions of different frame rates.
    """
    solver = XPBD() if solver is None else solver
    fps = motions[0].fps
    if any(m.fps != fps for m in motions):
        raise SimulationError("Motions of one batch need one frame rate: resample them.")
    body = scene.assembly.body
    rest = float32(scene.assembly.rest_body)
    leads = [lead_in(body, m) for m in motions]
    skipped = leads[0].num_frames
    longest = max(m.num_frames for m in motions)
    total = -(-(skipped + longest - 1) // _BLOCK) * _BLOCK + 1

    def stack(name: str) -> np.ndarray:
        rows = []
        for lead, m in zip(leads, motions, strict=True):
            first = np.asarray(getattr(lead, name))
            x = np.concatenate([first, np.asarray(getattr(m, name))[1:]])
            rows.append(x[np.minimum(np.arange(total), len(x) - 1)])
        return np.stack(rows, axis=1)

    rotations, root = stack("rotations"), stack("root")
    start = [
        animate(
            body,
            rest,
            float32(scene.assembly.rest),
            float32(scene.assembly.weights),
            Motion(lead.rotations[:1], lead.root[:1], fps),
        )[0]
        for lead in leads
    ]
    x = jnp.stack(start, axis=2)
    state = State(x, jnp.zeros_like(x))
    positions, diagnostics = [np.asarray(x)[None]], []
    for at in range(0, total - 1, _BLOCK):
        part = slice(at, at + _BLOCK + 1)
        state, moved, info = advance(
            body,
            rest,
            scene.effects,
            state,
            jnp.asarray(rotations[part]),
            jnp.asarray(root[part]),
            solver=solver,
            fps=fps,
        )
        positions.append(np.asarray(moved))
        diagnostics.append({k: np.asarray(v) for k, v in info.items()})
        if progress is not None:
            progress(min(at + _BLOCK, total - 1), total - 1)
    # Diagnostics start at frame 1: the rest state has none, so the lead-in covers it.
    every = np.concatenate(positions)
    values = {k: np.concatenate([d[k] for d in diagnostics]) for k in diagnostics[0]}
    out = []
    for b, m in enumerate(motions):
        frames = slice(skipped - 1, skipped - 1 + m.num_frames)
        flags = slice(skipped - 2, skipped - 2 + m.num_frames)
        garments = zip(scene.assembly.parts, scene.assembly.parts[1:])
        out.append(
            Rollout(
                tuple(np.ascontiguousarray(every[frames, i:j, :, b]) for i, j in garments),
                fps,
                {k: v[flags, b] for k, v in values.items()},
            )
        )
    return out
