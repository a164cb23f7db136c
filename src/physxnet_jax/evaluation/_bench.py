"""Work-precision benchmark of the solvers on three scenes."""

import dataclasses
import functools
import time
from collections.abc import Callable, Iterator, Mapping, Sequence

import jax
import numpy as np
from jaxtyping import Float

from ..errors import MissingDependencyError, PhysXNetError
from ..garment import Fabric, Garment, square_sheet, template
from ..motion import Motion, load_motion
from ..simulation import (
    PRESETS,
    ROLLOUT_BLOCK,
    XPBD,
    Implicit,
    PreparedScene,
    Rollout,
    Scene,
    Solver,
    Verlet,
    prepare_scene,
    settle_on_static_body,
    simulate_batch,
)
from ..simulation.blender import BlenderSettings, simulate_blender
from ..simulation.effects import Bend, BodyContact, Damping, Gravity, Pin, Stretch
from ..simulation.newton import NewtonSettings, simulate_newton
from ._motion_metrics import fold_strength
from ._penetration import penetration
from ._strain import edge_strain
from ._surface_faults import SurfaceFaults, surface_faults

_FPS = 30.0
_REPEATS = 3
# Every which frame is looked at for visible skin and crossing faces.
_LOOKED = 5
JITTER = "jitter 1e-6 m"
"""Setting of the row of the noise floor."""


@dataclasses.dataclass(frozen=True)
class Work:
    """One row of the table.

    Attributes:
        scene: ``sheet``, ``skirt`` or ``shirt``.
        solver: Name of the solver.
        setting: Substeps per frame, or another varied setting.
        rms_mm: RMS distance to the reference over vertices and frames [mm].
        max_mm: Maximum of that distance [mm].
        penetration_share: Share of cloth vertices inside the body, pinched ones excluded,
            over all frames (see `Penetration`).
        pinched_share: Share of cloth vertices that are pinched.
        penetrating_frames: Number of frames with vertices inside that aren't pinched.
        skin_outside_share: Share of skin that sticks out of the cloth over it.
        strain_p99: 99th percentile of the strain of edges.
        ms_per_frame: Median time of warm runs [ms].
        cold_s: Extra time of the first run, mostly compilation [s].
        reference: Name of the reference.
        failed: Why the run failed; empty if it succeeded.
        folds: Strength of the folds over the reference's.
        visible_skin: Share of the pixels of cloth that show skin which came through it.
        self_crossing: Share of faces that cross other faces.
    """

    scene: str
    solver: str
    setting: str
    rms_mm: float
    max_mm: float
    penetration_share: float
    pinched_share: float
    penetrating_frames: int
    skin_outside_share: float
    strain_p99: float
    ms_per_frame: float
    cold_s: float
    reference: str
    failed: str = ""
    folds: float = float("nan")
    visible_skin: float = float("nan")
    self_crossing: float = float("nan")


@dataclasses.dataclass(frozen=True)
class BenchScene:
    """A scene of the benchmark.

    Attributes:
        name: Its name in the table.
        scene: Garments and effects.
        motion: The body's motion; None if it is static.
        frames: Number of compared frames.
        reference: Solver of the reference.
        check: A finer or coarser solver, which shows how accurate the reference is.
    """

    name: str
    scene: Scene
    motion: Motion | None
    frames: int
    reference: Solver
    check: Solver


_ACTING = (Gravity(), Damping(), Stretch(), Bend(), BodyContact(), Pin())


def bench_scenes(
    shirt: Garment | None = None, action: Motion | None = None, frames: int = 20
) -> list[BenchScene]:
    """The three scenes: a hanging sheet, a swinging skirt, a shirt on a punch.

    Args:
        shirt: The shirt; the template ``top`` if None.
        action: Motion of the shirt's wearer; the built-in punch if None.
        frames: Number of frames of the skirt and the shirt.
    """
    soft = Fabric(stretch=300.0, bend=2e-5)
    sheet = square_sheet(17, 0.6, pinned=np.arange(17), fabric=soft)
    free = (Gravity(), Stretch(compression=1.0), Bend(), Pin())

    def first(m: Motion) -> Motion:
        return dataclasses.replace(m, rotations=m.rotations[:frames], root=m.root[:frames])

    punch = load_motion("punch", fps=_FPS) if action is None else action
    shirt = template("top") if shirt is None else shirt
    # In contact converged cloth is the reference: explicit steps of float64 aren't nearer to it.
    finest = PRESETS["reference"]
    assert isinstance(finest, XPBD)
    worn = (finest, dataclasses.replace(finest, substeps=4 * finest.substeps))
    return [
        BenchScene("sheet", Scene((sheet,), free), None, 15, Verlet(2048, 1), Verlet(1024, 1)),
        BenchScene(
            "skirt",
            Scene((template("dress"),), _ACTING),
            first(load_motion("spin", fps=_FPS)),
            frames,
            *worn,
        ),
        BenchScene("shirt", Scene((shirt,), _ACTING), first(punch), frames, *worn),
    ]


def solvers(worn: bool) -> list[tuple[str, str, Solver]]:
    """Name, setting and solver of every row of the package's solvers."""
    rows: list[tuple[str, str, Solver]] = []
    for n in (8, 16, 32, 64, 128, 256):
        rows.append(("xpbd", f"{n}", XPBD(n, 2 if worn and n > 64 else 1)))
    for n in (32, 128):
        rows.append(("xpbd order 1", f"{n}", XPBD(n, n // 8 if worn else 1, order=1)))
    for order, name in ((1, "backward euler"), (2, "bdf2")):
        for n in (4, 16) if worn else (4, 8, 16, 32):
            rows.append((name, f"{n}", Implicit(n, min(n, 4) if worn else 1, order=order)))
    return rows


def bench_simulation(
    scenes: Sequence[BenchScene],
    *,
    methods: Sequence[tuple[str, str, Solver]] | None = None,
    blender: Sequence[int] = (),
    newton: Sequence[int] = (),
    done: Sequence[Work] = (),
    progress: Callable[[str], None] | None = None,
) -> Iterator[Work]:
    """Measures every solver on every scene, row by row.

    The rows of a scene are: cloth that keeps its rest positions (it must be the worst), the
    package's solvers, the check against the reference, the noise floor (the default solver
    with the garment perturbed by 1e-6 m), and Blender and Newton, each against its finest
    setting.

    Args:
        scenes: See `bench_scenes`.
        methods: Name, setting and solver of the package's rows; `solvers` if None.
        blender: Qualities of Blender to run, the finest last; none if empty.
        newton: Substeps of Newton to run, likewise.
        done: Rows measured before, which are skipped.
        progress: Called with a description of each measurement.
    """
    measured = {(r.scene, r.solver, r.setting) for r in done}

    def report(text: str) -> None:
        if progress is not None:
            progress(text)

    for b in scenes:
        prepared = prepare_scene(b.scene)
        worn = b.motion is not None
        every = solvers(worn) if methods is None else methods
        own_rows = [s for s in every if (b.name, s[0], s[1]) not in measured]
        exact = b.reference.precision == "float64"
        ref = "verlet float64" if exact else "xpbd, reference"
        extras = [("nothing", ""), (ref, "check"), ("xpbd", JITTER)]
        extras = [e for e in extras if (b.name, *e) not in measured]
        if own_rows or extras:
            report(f"{b.name}: reference")
            truth, _, _ = _timed(b, prepared, b.reference, repeats=1)
        if ("nothing", "") in extras:
            yield _row(b, prepared, "nothing", "", _at_rest(b, prepared), truth, 0.0, 0.0, ref)
        for name, setting, solver in own_rows:
            report(f"{b.name}: {name}, {setting}")
            yield _attempt(b, prepared, name, setting, solver, truth, ref)
            jax.clear_caches()
        if (ref, "check") in extras:
            report(f"{b.name}: check of the reference")
            x, ms, cold = _timed(b, prepared, b.check, repeats=1)
            yield _row(b, prepared, ref, "check", x, truth, ms, cold, ref)
            jax.clear_caches()
        if ("xpbd", JITTER) in extras:
            report(f"{b.name}: noise floor")
            usual = PRESETS["standard"] if worn else XPBD(128, 1)
            base, ms, cold = _timed(b, prepared, usual, repeats=1)
            moved = prepare_scene(dataclasses.replace(b.scene, garments=_jittered(b.scene)))
            x, ms, _ = _timed(b, moved, usual, repeats=1)
            yield _row(b, prepared, "xpbd", JITTER, x, base, ms, cold, "xpbd, 128 substeps")
            jax.clear_caches()
        if worn:
            peers: dict[str, dict[str, Callable[[Motion], Rollout]]] = {
                "blender": {
                    f"quality {q}": functools.partial(
                        simulate_blender, b.scene, settings=BlenderSettings(quality=q)
                    )
                    for q in blender
                },
                "newton": {
                    f"{n} substeps": functools.partial(
                        simulate_newton, b.scene, settings=NewtonSettings(substeps=n)
                    )
                    for n in newton
                },
            }
            for name, runs in peers.items():
                yield from _peer(b, prepared, name, runs, measured, report)


def _attempt(
    b: BenchScene,
    prepared: PreparedScene,
    name: str,
    setting: str,
    solver: Solver,
    truth: Float[np.ndarray, "frames vertices 3"],
    ref: str,
) -> Work:
    try:
        x, ms, cold = _timed(b, prepared, solver)
        return _row(b, prepared, name, setting, x, truth, ms, cold, ref)
    except PhysXNetError as error:
        return _failure(b.name, name, setting, str(error), ref)


def _failure(scene: str, name: str, setting: str, why: str, ref: str) -> Work:
    nan = float("nan")
    return Work(scene, name, setting, nan, nan, nan, nan, 0, nan, nan, nan, nan, ref, why)


def _run(b: BenchScene, prepared: PreparedScene, solver: Solver) -> tuple[Rollout, list[float]]:
    ticks = [time.perf_counter()]
    if b.motion is None:
        out = settle_on_static_body(prepared, b.frames, solver=solver, fps=_FPS)
        ticks.append(time.perf_counter())
        return out, [(ticks[1] - ticks[0]) / b.frames]
    out = simulate_batch(
        prepared, [b.motion], solver=solver, progress=lambda *_: ticks.append(time.perf_counter())
    )[0]
    return out, (np.diff(ticks) / ROLLOUT_BLOCK).tolist()


def _timed(
    b: BenchScene, prepared: PreparedScene, solver: Solver, repeats: int = _REPEATS
) -> tuple[Float[np.ndarray, "frames vertices 3"], float, float]:
    """Positions, warm time per frame [ms], and extra time of the first run [s]."""
    began = time.perf_counter()
    out, laps = _run(b, prepared, solver)
    first = time.perf_counter() - began
    out.check()
    warm = laps[1:]
    if b.motion is None or repeats > 1:
        began = time.perf_counter()
        for _ in range(repeats if b.motion is None else 1):
            warm = warm + _run(b, prepared, solver)[1]
    typical = float(np.median(warm))
    cold = first - typical * len(laps) * (b.frames if b.motion is None else ROLLOUT_BLOCK)
    return out.positions[0], 1e3 * typical, max(cold, 0.0)


def _row(
    b: BenchScene,
    prepared: PreparedScene,
    name: str,
    setting: str,
    x: Float[np.ndarray, "frames vertices 3"],
    truth: Float[np.ndarray, "frames vertices 3"],
    ms: float,
    cold: float,
    ref: str,
) -> Work:
    gap = np.linalg.norm(np.asarray(x, np.float64) - truth, axis=2)
    inside, pinched, frames, skin = 0.0, 0.0, 0, 0.0
    faults = SurfaceFaults(0.0, 0.0)
    if b.motion is not None:
        seen = penetration(prepared.assembly, b.motion, np.asarray(x, np.float32))
        wrong = seen.cloth_inside & ~seen.pinched
        inside, pinched = float(wrong.mean()), float(seen.pinched.mean())
        frames = int(wrong.any(axis=1).sum())
        skin = float(seen.skin_outside.mean())
        looked = np.arange(0, len(x), _LOOKED)
        faults = surface_faults(prepared.assembly, b.motion, x, frames=looked)
    faces = prepared.assembly.faces
    return Work(
        b.name,
        name,
        setting,
        1e3 * float(np.sqrt((gap**2).mean())),
        1e3 * float(gap.max()),
        inside,
        pinched,
        frames,
        skin,
        float(np.quantile(edge_strain(prepared.assembly, x), 0.99)),
        ms,
        cold,
        ref,
        "",
        fold_strength(faces, x) / max(fold_strength(faces, truth), 1e-6),
        faults.visible_skin,
        faults.self_crossing,
    )


def _at_rest(b: BenchScene, prepared: PreparedScene) -> Float[np.ndarray, "frames vertices 3"]:
    """The trivial baseline: cloth that keeps its rest positions."""
    rest = prepared.assembly.rest.astype(np.float32)
    return np.repeat(rest[None], b.frames, axis=0)


def _jittered(scene: Scene) -> tuple[Garment, ...]:
    rng = np.random.default_rng(0)

    def one(g: Garment) -> Garment:
        noise = 1e-6 * rng.normal(size=g.mesh.vertices.shape).astype(np.float32)
        mesh = dataclasses.replace(g.mesh, vertices=g.mesh.vertices + noise)
        return dataclasses.replace(g, mesh=mesh, offset=g.offset + noise)

    return tuple(one(g) for g in scene.garments)


def _peer(
    b: BenchScene,
    prepared: PreparedScene,
    name: str,
    runs: Mapping[str, Callable[[Motion], Rollout]],
    measured: set[tuple[str, str, str]],
    report: Callable[[str], None],
) -> Iterator[Work]:
    """An external simulator at several settings, each against the last one."""
    if all((b.name, name, setting) in measured for setting in runs):
        return
    ref = f"{name}, {list(runs)[-1]}"
    results: dict[str, Rollout] = {}
    assert b.motion is not None
    for setting, run in runs.items():
        report(f"{b.name}: {name}, {setting}")
        try:
            results[setting] = run(b.motion)
        except MissingDependencyError:
            raise
        except PhysXNetError as error:
            yield _failure(b.name, name, setting, str(error), ref)
    if ref.removeprefix(f"{name}, ") not in results:
        return
    truth = results[list(runs)[-1]].positions[0]
    for setting, out in results.items():
        ms = float(np.median(out.diagnostics["milliseconds"][1:]))
        yield _row(b, prepared, name, setting, out.positions[0], truth, ms, 0.0, ref)


def time_to_error(rows: Sequence[Work], limit_mm: float) -> Work | None:
    """The fastest row of the package's solvers within an RMS error, if any.

    Args:
        rows: Rows of one scene.
        limit_mm: Largest RMS error [mm].
    """
    good = [
        r
        for r in rows
        if not r.failed
        and r.rms_mm <= limit_mm
        and r.ms_per_frame > 0
        and not r.reference.startswith(("blender", "newton"))
        and r.setting not in ("check", JITTER)
    ]
    return min(good, key=lambda r: r.ms_per_frame, default=None)
