"""Cost and influence of each effect of a scene."""

import dataclasses
import math
import time
from collections.abc import Callable, Sequence

import jax.numpy as jnp
import numpy as np

from ..motion import Motion
from ..simulation import (
    ROLLOUT_BLOCK,
    Effect,
    PreparedScene,
    Rollout,
    Scene,
    Solver,
    State,
    advance,
    make_system,
    prepare_scene,
    simulate_batch,
)
from ..simulation.effects import Air, BodyContact, Damping, Floor, LayerContact, Pin, SelfContact
from ._penetration import penetration
from ._strain import edge_strain

_SAMPLED_FRAMES = 3


@dataclasses.dataclass(frozen=True)
class Price:
    """A scene without one of its effects, compared with the whole scene.

    Attributes:
        without: The effect left out; empty for the whole scene.
        frames: Number of simulated frames.
        rms_mm: RMS distance to the whole scene's cloth, over vertices and frames [mm].
        max_mm: Maximum of that distance [mm].
        strain_p99: 99th percentile of the strain of edges, over all frames.
        inside_share: Share of vertices inside the body in sampled frames, pinched ones
            excluded.
        ms_per_frame: Median warm time [ms].
        mflop: Floating-point operations of the program as counted by XLA, which counts
            every loop's body once: a frame of one contact interval of one substep [Mflop].
        cold_s: Time of the first frames, including compilation [s].
        jitter_mm: RMS distance of the whole scene's cloth from that of a root moved by 1e-6 m in
            each frame [mm]: smaller changes can't be measured.
    """

    without: str
    frames: int
    rms_mm: float
    max_mm: float
    strain_p99: float
    inside_share: float
    ms_per_frame: float
    mflop: float
    cold_s: float
    jitter_mm: float


@dataclasses.dataclass(frozen=True)
class Advice:
    """Whether a scene needs an effect.

    Attributes:
        effect: Name of the effect.
        needed: Whether it changes the cloth by more than the tolerance.
        why: The measurements, as text.
        added: The effect, if the scene lacks it.
    """

    effect: str
    needed: bool
    why: str
    added: Effect | None = None


def recommended_effects(scene: Scene, advice: Sequence[Advice]) -> tuple[Effect, ...]:
    """The effects of a scene without those that aren't needed, and with those that are.

    Args:
        scene: The scene.
        advice: Result of `recommend_effects`.
    """
    unneeded = {a.effect for a in advice if not a.needed}
    effects = tuple(e for e in scene.effects if type(e).__name__ not in unneeded)
    for a in advice:
        if a.needed and a.added is not None:
            effects = _with_effect(effects, a.added)
    return effects


def _with_effect(effects: tuple[Effect, ...], added: Effect) -> tuple[Effect, ...]:
    """Effects with one more, before contact with the body; air replaces damping."""
    kept = tuple(e for e in effects if not (isinstance(added, Air) and isinstance(e, Damping)))
    at = next((i for i, e in enumerate(kept) if isinstance(e, BodyContact)), len(kept))
    return (*kept[:at], added, *kept[at:])


def price_effects(
    scene: Scene,
    motion: Motion,
    *,
    solver: Solver,
    progress: Callable[[int, int], None] | None = None,
) -> list[Price]:
    """Simulates a scene whole and without each of its effects in turn.

    Args:
        scene: The scene.
        motion: The motion; one second is already informative.
        solver: The solver.
        progress: Called with the variants done and the total.

    Returns:
        The whole scene's row, then one for each effect.
    """
    return _price(scene, motion, solver, progress)[0]


def _price(
    scene: Scene,
    motion: Motion,
    solver: Solver,
    progress: Callable[[int, int], None] | None,
) -> tuple[list[Price], Rollout]:
    """The rows of `price_effects`, and the whole scene's rollout."""
    prepared = prepare_scene(scene)
    base, whole = _measure(prepared, motion, solver, None, "")
    base = dataclasses.replace(base, jitter_mm=_noise_floor(prepared, motion, solver, whole))
    rows = [base]
    count = len(scene.effects)
    acting = [e for e in scene.effects if not e.idle(prepared.assembly)]
    for k, e in enumerate(scene.effects):
        # The program before isn't run again.
        advance.clear_cache()  # pyright: ignore[reportAttributeAccessIssue]
        if progress is not None:
            progress(k + 1, count + 1)
        others = tuple(x for x in scene.effects if x is not e)
        if isinstance(e, Pin):
            # Held vertices have another mass.
            rest = prepare_scene(dataclasses.replace(scene, effects=others))
        else:
            pairs = zip(acting, prepared.effects, strict=True)
            kept = tuple(p for x, p in pairs if x is not e)
            rest = dataclasses.replace(prepared, effects=kept)
        row, _ = _measure(rest, motion, solver, whole, type(e).__name__)
        rows.append(dataclasses.replace(row, jitter_mm=base.jitter_mm))
    advance.clear_cache()  # pyright: ignore[reportAttributeAccessIssue]
    if progress is not None:
        progress(count + 1, count + 1)
    return rows, whole


def recommend_effects(
    scene: Scene,
    motion: Motion,
    *,
    solver: Solver,
    tolerance: float = 2e-3,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[list[Price], list[Advice]]:
    """Measures which effects matter for a scene.

    The scene's effects are left out one by one (`price_effects`). Drag of still air,
    self-contact, a floor and layer contact are added one by one if the scene lacks them.

    Args:
        scene: The scene.
        motion: The motion.
        solver: The solver.
        tolerance: RMS distance of the cloth above which an effect matters [m].
        progress: Called with the variants done and the total.

    Returns:
        The rows of `price_effects`, and what follows from them.
    """
    kinds = {type(e) for e in scene.effects}
    extra: list[Effect] = [Air()] if Air not in kinds else []
    if SelfContact not in kinds:
        extra.append(SelfContact())
    if Floor not in kinds:
        extra.append(Floor())
    if LayerContact not in kinds and len(scene.garments) > 1:
        extra.append(LayerContact())
    total = 1 + len(scene.effects) + len(extra)

    def tick(done: int, _: int) -> None:
        if progress is not None:
            progress(done, total)

    rows, whole = _price(scene, motion, solver, tick)
    base, out = rows[0], judge_effects(rows, tolerance)
    for k, e in enumerate(extra):
        effects = _with_effect(scene.effects, e)
        more = prepare_scene(dataclasses.replace(scene, effects=effects))
        row, rollout = _measure(more, motion, solver, whole, "")
        name = type(e).__name__
        seen = "" if row.rms_mm > base.jitter_mm else "No measurable effect. "
        reason = (
            f"{seen}With it the cloth moves by {row.rms_mm:.1f} mm; it costs"
            f" {row.ms_per_frame - base.ms_per_frame:.1f} ms a frame."
        )
        needed = row.rms_mm > max(1e3 * tolerance, base.jitter_mm)
        if isinstance(e, SelfContact):
            least = float(rollout.diagnostics["self_gap"].min())
            if least >= e.gap:
                needed = False
                near = "within the search range of self-contact"
                if math.isfinite(least):
                    near = f"nearer to itself than {1e3 * least:.1f} mm"
                reason = f"Cloth never comes {near}."
        out.append(Advice(name, needed, reason, e))
        advance.clear_cache()  # pyright: ignore[reportAttributeAccessIssue]
        tick(1 + len(scene.effects) + k + 1, total)
    return rows, out


def judge_effects(rows: Sequence[Price], tolerance: float = 2e-3) -> list[Advice]:
    """Whether the effects of a scene matter, by the rows of `price_effects`.

    Args:
        rows: The whole scene, then without each effect.
        tolerance: RMS distance of the cloth above which an effect matters [m].
    """
    base = rows[0]
    out = []
    for r in rows[1:]:
        inside = r.inside_share - base.inside_share
        strain = r.strain_p99 - base.strain_p99
        needed = r.rms_mm > max(1e3 * tolerance, r.jitter_mm) or inside > 1e-3 or strain > 0.05
        seen = "" if r.rms_mm > r.jitter_mm else "No measurable effect. "
        out.append(
            Advice(
                r.without,
                needed,
                f"{seen}Without it the cloth moves by {r.rms_mm:.1f} mm (inside the body"
                f" {100 * inside:+.1f} %, strain {100 * strain:+.0f} %); it costs"
                f" {base.ms_per_frame - r.ms_per_frame:.1f} ms a frame.",
            )
        )
    return out


def _noise_floor(scene: PreparedScene, motion: Motion, solver: Solver, whole: Rollout) -> float:
    """RMS distance of two runs that differ by 1e-6 m [mm]."""
    noise = np.random.default_rng(0).normal(0.0, 1e-6, motion.root.shape)
    moved = dataclasses.replace(motion, root=motion.root + jnp.asarray(noise, jnp.float32))
    (again,) = simulate_batch(scene, [moved], solver=solver)
    gap = np.concatenate(again.positions, axis=1) - np.concatenate(whole.positions, axis=1)
    return 1e3 * float(np.sqrt(np.mean(np.sum(gap * gap, axis=2))))


def _measure(
    prepared: PreparedScene, motion: Motion, solver: Solver, whole: Rollout | None, name: str
) -> tuple[Price, Rollout]:
    flops = program_flops(prepared, solver, motion.fps)
    ticks = [time.perf_counter()]
    rollout = simulate_batch(
        prepared, [motion], solver=solver, progress=lambda *_: ticks.append(time.perf_counter())
    )[0]
    laps = np.diff(ticks)
    x = np.concatenate(rollout.positions, axis=1)
    gap = np.zeros(1)
    if whole is not None:
        gap = np.linalg.norm(x - np.concatenate(whole.positions, axis=1), axis=2)
    sampled = np.linspace(0, len(x) - 1, min(_SAMPLED_FRAMES, len(x))).astype(int)
    inside = penetration(prepared.assembly, motion, x, frames=sampled)
    return (
        Price(
            name,
            len(x),
            1e3 * float(np.sqrt((gap**2).mean())),
            1e3 * float(gap.max()),
            float(np.quantile(edge_strain(prepared.assembly, x), 0.99)),
            float((inside.cloth_inside & ~inside.pinched).mean()),
            1e3 * float(np.median(laps[1:] if len(laps) > 1 else laps)) / ROLLOUT_BLOCK,
            flops / 1e6,
            float(laps[0]),
            0.0,
        ),
        rollout,
    )


def program_flops(scene: PreparedScene, solver: Solver, fps: float) -> float:
    """Floating-point operations of a frame's program, with every loop's body counted once."""
    system = make_system(scene, solver)
    n, joints = len(scene.assembly.rest), len(scene.assembly.body.joint_names)
    x = jnp.zeros((n, 3, 1), solver.precision)
    state = State(
        x,
        x,
        solver.init_state(x, 1.0 / (fps * solver.substeps)),
        tuple(e.init_state(1) for e in system.effects),
    )
    frame = advance.lower(
        system,
        state,
        jnp.zeros((2, 1, joints, 4), solver.precision),
        jnp.zeros((2, 1, 3), solver.precision),
        solver=solver,
        fps=fps,
        time=jnp.zeros((), solver.precision),
    )
    cost = frame.cost_analysis() or {}
    return float(cost.get("flops", 0.0))
