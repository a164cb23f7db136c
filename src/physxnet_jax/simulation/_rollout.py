"""Rollouts: simulate a scene through a motion, starting at rest."""

import pathlib
from collections.abc import Callable
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from scipy.spatial.transform import Rotation, Slerp

from .._environment import clear_caches_if_full
from ..body import Body
from ..devices import make_mesh
from ..errors import SimulationError, check_rate, check_type
from ..files import claims
from ..frames import FrameStore
from ..motion import Motion, animate, ground_point
from ._advance import advance_on, start_state
from ._assembly import float32
from ._diagnostics import Rollout
from ._prepared_scene import PreparedScene
from ._resume import Resume, fingerprint
from ._scene import Scene, make_system, prepare_scene
from ._slip import slipped
from ._solver import Solver
from ._xpbd import XPBD

# Frames per compiled call: clips of any length are split into blocks of this many frames.
ROLLOUT_BLOCK = 10


def warmup(body: Body, motion: Motion, *, seconds: float = 1.5, settle: float = 0.4) -> Motion:
    """Warm-up: a smooth transition from the rest pose to a clip's first frame.

    The body has the clip's first position and heading. It holds the rest pose while the
    cloth settles, then moves smoothly to the first pose.

    Args:
        body: The body.
        motion: The clip.
        seconds: Length of the warm-up [s].
        settle: Part of it in which the body holds the rest pose [s].

    Returns:
        The warm-up without the clip; its last frame is the clip's first.
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
    return Motion(float32(rotations), jax.device_put(root), motion.fps, f"{motion.name} warm-up")


Accuracy = Literal["draft", "standard", "fine", "reference"]
"""Names of `PRESETS`, from the fastest to converged cloth."""

PRESETS: dict[str, Solver] = {
    "draft": XPBD(substeps=32, contact_updates=1),
    "standard": XPBD(substeps=128, contact_updates=2),
    "fine": XPBD(substeps=256, contact_updates=2),
    "reference": XPBD(substeps=512, contact_updates=8),
}
"""Solvers by accuracy, for 30 frames per second; `Solver.at_rate` converts to other rates.

docs/simulation.md has the distance of each preset to ``reference``, its time, and how much four
times the substeps of ``reference`` change next to a jitter of 1e-6 m.
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
        accuracy: ``draft``, ``standard``, ``fine`` or ``reference``, see `PRESETS`.
        solver: Overrides the solver of ``accuracy``.
        progress: Called with the number of frames done and the total.
        energies: Include the energy of each effect in the diagnostics.
        throw: Raise if a frame isn't finite; if False, only `Rollout.status` reports it.
        resume: Folder for finished blocks, see `simulate_batch`.

    Returns:
        Positions of each garment in every frame, and diagnostics. The warm-up from
        the rest pose is simulated but not returned.

    Raises:
        SimulationError: A frame isn't finite; the message names the frame, the vertex
            and the likely cause. Or ``accuracy`` is unknown.
    """
    _check_motion(motion)
    if accuracy not in PRESETS:
        raise SimulationError(f"Unknown accuracy '{accuracy}'; choose {', '.join(PRESETS)}.")
    out = simulate_batch(
        prepare_scene(scene),
        [motion],
        solver=PRESETS[accuracy].at_rate(motion.fps) if solver is None else solver,
        progress=progress,
        energies=energies,
        resume=resume,
    )[0]
    if throw:
        out.check()
    return out


def _check_motion(motion: object) -> None:
    check_type(motion, Motion, "Pass a Motion, as load_motion('walk') gives.")
    assert isinstance(motion, Motion)
    check_rate(motion.fps)
    q, p = (np.asarray(x) for x in (motion.rotations, motion.root))
    if len(q) != len(p) or not len(q):
        raise SimulationError(f"The motion has {len(q)} rotations and {len(p)} places of the root.")
    turns = np.isfinite(q).all(axis=2) & (np.abs(q).max(axis=2) > 1e-6)
    bad = ~np.isfinite(p).all(axis=1) | ~turns.all(axis=1)
    if bad.any():
        raise SimulationError(
            f"Frame {int(bad.argmax())} of the motion isn't finite, or states no rotation:"
            " make_motion names what is wrong."
        )


@claims("resume")
def simulate_batch(
    scene: Scene | PreparedScene,
    motions: list[Motion],
    *,
    solver: Solver | None = None,
    progress: Callable[[int, int], None] | None = None,
    energies: bool = False,
    resume: str | pathlib.Path | None = None,
    devices: int | None = None,
) -> list[Rollout]:
    """Simulates several motions as one batch; each result has its motion's length.

    On several devices each simulates an equal share of the people; a person's result is then that
    of a batch of such a share.

    Args:
        scene: The scene, or a prepared one, which saves the time of preparing it again.
        motions: Clips with the same frame rate. Shorter ones hold their last pose.
        solver: Solver of the cloth; ``standard`` by default.
        progress: Called with the number of frames done and the total.
        energies: Include the energy of each effect in the diagnostics.
        resume: Folder for finished blocks. The same call resumes from them after an
            interruption and removes them at the end. If None, nothing is stored.
        devices: Devices of this machine to use; all of them by default, but one for each person.

    Returns:
        One rollout per motion.

    Raises:
        SimulationError: No motion, motions of different frame rates, or a folder that
            belongs to another rollout.
        BusyError: Another process simulates with the same ``resume``.
        PhysXNetError: This machine has fewer devices.
    """
    if not motions:
        raise SimulationError("No motion to simulate; pass at least one.")
    clear_caches_if_full()
    for motion in motions:
        _check_motion(motion)
    if not isinstance(scene, PreparedScene):
        scene = prepare_scene(scene)
    used = min(len(jax.local_devices()), len(motions)) if devices is None else devices
    missing = -len(motions) % max(used, 1)
    mesh = make_mesh(len(motions) + missing, used, local=True)
    places = [ground_point(m) for m in motions]
    local = [m.moved(-p) for m, p in zip(motions, places, strict=True)]
    padded = [*local, *missing * local[-1:]]
    solver = PRESETS["standard"].at_rate(motions[0].fps) if solver is None else solver
    # Limited to tracing and execution: the rest of the process keeps its precision.
    with jax.enable_x64(solver.precision == "float64"):
        found = _roll(scene, padded, solver, progress, energies, resume, mesh)
    return [r.moved(p) for r, p in zip(found, places, strict=False)]


def _roll(
    scene: PreparedScene,
    motions: list[Motion],
    solver: Solver,
    progress: Callable[[int, int], None] | None,
    energies: bool,
    resume: str | pathlib.Path | None,
    mesh: Mesh,
) -> list[Rollout]:
    fps = motions[0].fps
    if any(m.fps != fps for m in motions):
        raise SimulationError("All motions of a batch need the same frame rate; resample them.")
    system = make_system(scene, solver)
    body = scene.assembly.body
    rest = float32(scene.assembly.rest_body)
    warmups = [warmup(body, m) for m in motions]
    warmup_frames = warmups[0].num_frames
    longest = max(m.num_frames for m in motions)
    total = -(-(warmup_frames + longest - 1) // ROLLOUT_BLOCK) * ROLLOUT_BLOCK + 1

    def stack(name: str) -> np.ndarray:
        rows = []
        for warmup_motion, m in zip(warmups, motions, strict=True):
            first = np.asarray(getattr(warmup_motion, name))
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
            Motion(warmup_motion.rotations[:1], warmup_motion.root[:1], fps),
        )[0]
        for warmup_motion in warmups
    ]
    x = jnp.stack(start, axis=2).astype(solver.precision)
    state = start_state(system, x, solver=solver, fps=fps)
    # Time zero is the clip's first frame, whatever the length of the warm-up.
    start_time = -(warmup_frames - 1) / fps
    store = None
    diagnostics: list[dict[str, np.ndarray]] = []
    frames_of = [FrameStore(m.num_frames) for m in motions]

    def keep(arrays: dict[str, np.ndarray]) -> None:
        """Keeps a block without the frames of the warm-up, and those after a motion's end."""
        first = ROLLOUT_BLOCK * len(diagnostics) - (warmup_frames - 2)
        block = arrays.pop("positions")
        diagnostics.append(arrays)
        for b, (m, kept) in enumerate(zip(motions, frames_of, strict=True)):
            rows = slice(max(-first, 0), max(m.num_frames - first, 0))
            kept.append(block[rows, :, :, b])

    if resume is not None:
        key = fingerprint(system, rotations, root, (solver, energies, fps))
        store = Resume(resume, key)
        for reached, arrays in store.blocks(state):
            state = reached
            keep(arrays)
    for at in range(ROLLOUT_BLOCK * len(diagnostics), total - 1, ROLLOUT_BLOCK):
        part = slice(at, at + ROLLOUT_BLOCK + 1)
        state, new_positions, info = advance_on(
            mesh,
            system,
            state,
            jax.device_put(rotations[part]),
            jax.device_put(root[part]),
            solver=solver,
            fps=fps,
            time=jnp.asarray(start_time + at / fps, solver.precision),
            energies=energies,
        )
        arrays = {"positions": new_positions} | info
        arrays = {k: np.asarray(v) for k, v in arrays.items()}
        if store is not None:
            store.save(len(diagnostics), state, arrays)
        keep(arrays)
        if progress is not None:
            progress(min(at + ROLLOUT_BLOCK, total - 1), total - 1)
    if store is not None:
        store.finish()
    # Diagnostics start at frame 1, as the rest state has none; it belongs to the warm-up.
    values = {k: np.concatenate([d[k] for d in diagnostics]) for k in diagnostics[0]}
    out = []
    for b, m in enumerate(motions):
        flags = slice(warmup_frames - 2, warmup_frames - 2 + m.num_frames)
        garments = zip(scene.assembly.parts, scene.assembly.parts[1:])
        cloth = frames_of[b].array()
        slid = slipped(scene.assembly, m, cloth).max(axis=1, initial=0.0)
        out.append(
            Rollout(
                tuple(cloth[:, i:j] for i, j in garments),
                fps,
                {k: v[flags, b] for k, v in values.items()} | {"slipped": slid},
                m.name,
            )
        )
    return out
