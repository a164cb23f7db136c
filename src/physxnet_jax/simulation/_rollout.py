"""Rollouts: a scene through a motion, from rest, frame by frame."""

import pathlib
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from .._environment import free_programs
from ..body import Body
from ..errors import SimulationError
from ..motion import Motion, animate
from ._advance import advance, start_state
from ._assembly import float32
from ._diagnostics import Rollout
from ._resume import Resume, fingerprint
from ._scene import PreparedScene, Scene, prepare_scene
from ._solver import Solver
from ._xpbd import XPBD

# Frames compiled together: clips of any length are cut into blocks of this many.
ROLLOUT_BLOCK = 10


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


ACCURACY: dict[str, Solver] = {
    "draft": XPBD(substeps=16, queries=2),
    "standard": XPBD(substeps=32, queries=4),
    "fine": XPBD(substeps=128, queries=8),
}
"""The one knob, for 30 frames a second; `Solver.at_rate` gives the same for others.

Cost is proportional to the substeps, the error about inversely.
"""


def simulate(
    scene: Scene,
    motion: Motion,
    *,
    accuracy: str = "standard",
    solver: Solver | None = None,
    progress: Callable[[int, int], None] | None = None,
    energies: bool = False,
    throw: bool = True,
    resume: str | pathlib.Path | None = None,
) -> Rollout:
    """Simulates a scene through a motion.

    Args:
        scene: Garments, body and effects.
        motion: The body's motion.
        accuracy: ``draft``, ``standard`` or ``fine``, see `ACCURACY`.
        solver: A solver set by hand, instead.
        progress: Called with frames done and frames in all.
        energies: Put the energy of each effect into the diagnostics.
        throw: Raise if a frame isn't finite; otherwise the status tells.
        resume: Folder in which blocks are kept until all are done, see `simulate_batch`.

    Returns:
        Positions of each garment in every frame, and diagnostics. The lead-in from
        the rest pose is simulated and left out.

    Raises:
        SimulationError: A frame that isn't finite; its number, the vertex and the
            likely cause are named.
    """
    if accuracy not in ACCURACY:
        raise SimulationError(f"No accuracy '{accuracy}'; there are {', '.join(ACCURACY)}.")
    out = simulate_batch(
        prepare_scene(scene),
        [motion],
        solver=ACCURACY[accuracy].at_rate(motion.fps) if solver is None else solver,
        progress=progress,
        energies=energies,
        resume=resume,
    )[0]
    if throw:
        out.check()
    return out


def simulate_batch(
    scene: PreparedScene,
    motions: list[Motion],
    *,
    solver: Solver | None = None,
    progress: Callable[[int, int], None] | None = None,
    energies: bool = False,
    resume: str | pathlib.Path | None = None,
) -> list[Rollout]:
    """Several motions side by side; each result is cut to its motion's length.

    Args:
        scene: The scene, prepared.
        motions: Clips of one frame rate. Shorter ones hold their last pose.
        solver: How the cloth moves; ``standard`` by default.
        progress: Called with frames done and frames in all.
        energies: Put the energy of each effect into the diagnostics.
        resume: Folder that keeps what is done: the same call goes on from there after
            it was stopped, and removes it at the end. None keeps nothing.

    Returns:
        One rollout a motion.

    Raises:
        SimulationError: No motion, motions of different frame rates, or a folder that
            belongs to another rollout.
    """
    if not motions:
        raise SimulationError("No motion to simulate; give at least one.")
    free_programs()
    solver = ACCURACY["standard"].at_rate(motions[0].fps) if solver is None else solver
    # Only around what is traced and run: the rest of the process keeps its precision.
    with jax.enable_x64(solver.precision == "float64"):
        return _roll(scene, motions, solver, progress, energies, resume)


def _roll(
    scene: PreparedScene,
    motions: list[Motion],
    solver: Solver,
    progress: Callable[[int, int], None] | None,
    energies: bool,
    resume: str | pathlib.Path | None,
) -> list[Rollout]:
    fps = motions[0].fps
    if any(m.fps != fps for m in motions):
        raise SimulationError("Motions of one batch need one frame rate: resample them.")
    system = scene.system(solver)
    body = scene.assembly.body
    rest = float32(scene.assembly.rest_body)
    leads = [lead_in(body, m) for m in motions]
    skipped = leads[0].num_frames
    longest = max(m.num_frames for m in motions)
    total = -(-(skipped + longest - 1) // ROLLOUT_BLOCK) * ROLLOUT_BLOCK + 1

    def stack(name: str) -> np.ndarray:
        rows = []
        for lead, m in zip(leads, motions, strict=True):
            first = np.asarray(getattr(lead, name))
            x = np.concatenate([first, np.asarray(getattr(m, name))[1:]])
            rows.append(x[np.minimum(np.arange(total), len(x) - 1)])
        return np.stack(rows, axis=1)

    rotations, root = (stack(n).astype(solver.precision) for n in ("rotations", "root"))
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
    x = jnp.stack(start, axis=2).astype(solver.precision)
    state = start_state(system, x, solver=solver, fps=fps)
    # Time zero is the clip's first frame, whatever the lead-in's length.
    began = -(skipped - 1) / fps
    store = None
    positions: list[np.ndarray] = []
    diagnostics: list[dict[str, np.ndarray]] = []
    if resume is not None:
        key = fingerprint(system, rotations, root, (solver, energies, fps))
        store = Resume(resume, key)
        state, positions, diagnostics = store.load(state)
    for at in range(ROLLOUT_BLOCK * len(positions), total - 1, ROLLOUT_BLOCK):
        part = slice(at, at + ROLLOUT_BLOCK + 1)
        state, moved, info = advance(
            system,
            state,
            jnp.asarray(rotations[part]),
            jnp.asarray(root[part]),
            solver=solver,
            fps=fps,
            time=jnp.asarray(began + at / fps, solver.precision),
            energies=energies,
        )
        positions.append(np.asarray(moved))
        diagnostics.append({k: np.asarray(v) for k, v in info.items()})
        if store is not None:
            store.save(len(positions) - 1, state, positions[-1], diagnostics[-1])
        if progress is not None:
            progress(min(at + ROLLOUT_BLOCK, total - 1), total - 1)
    if store is not None:
        store.finish()
    # Diagnostics start at frame 1: the rest state has none, so the lead-in covers it.
    every = np.concatenate([np.asarray(x)[None], *positions])
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
                m.name,
            )
        )
    return out
