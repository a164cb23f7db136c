"""`physxnet simulate` and `physxnet effects`."""

import dataclasses
import pathlib
import time

import numpy as np
from rich.console import Console
from rich.table import Table

from ..body import load_body
from ..dressing import SceneFile, animated_meshes, load_scene, make_scene
from ..errors import FormatError
from ..evaluation import ENGINES, price_effects, recommend_effects
from ..files import check_writable, write_json
from ..io import check_output, write_clip
from ..simulation import (
    ACCURACY,
    Air,
    Effect,
    Implicit,
    Rollout,
    SelfContact,
    Status,
    prepare_scene,
    simulate_batch,
)
from ..viewer import check_preview, render_preview
from ._progress import UNWRITTEN, print_json, progress_bars
from ._simulation_commands import Effects, Simulate


def simulate(command: Simulate, console: Console) -> int:
    """Simulates, writes, and says how it went."""
    if command.out is not None:
        check_output(command.out)
    if command.preview is not None:
        check_preview(command.preview)
    if command.out is None and command.preview is None and not command.json:
        console.print(UNWRITTEN)
    _check_engine(command)
    also: list[Effect] = []
    if command.wind is not None:
        also.append(Air(wind=command.wind))
    if command.self_contact:
        also.append(SelfContact())
    if _is_scene(command.scene):
        job = _scene_file(command)
    else:
        job = make_scene(
            command.scene,
            command.wear,
            fps=command.fps,
            source_fps=command.source_fps,
            skeleton=command.skeleton,
            joint_map=command.joint_map,
            start=command.start,
            frames=command.frames,
            fabric=command.fabric,
            also=also,
        )
    scene = job.scene
    if command.out is not None:
        check_output(command.out, job.motion.num_frames)
    accuracy = command.accuracy or job.accuracy
    out = command.out or command.preview
    keep = None if out is None else out.with_name(f".{out.name}.unfinished")
    began = time.perf_counter()
    with progress_bars(Console(quiet=True, markup=False) if command.json else console) as bars:

        def progress(done: int, total: int) -> None:
            bars("simulation", done, total)

        if command.engine in ENGINES:
            rollout = ENGINES[command.engine](scene, job.motion, progress=progress)
        else:
            solver = Implicit(16, 4) if command.engine == "bdf2" else ACCURACY[accuracy]
            solver = solver.at_rate(job.motion.fps)
            rollout = simulate_batch(
                prepare_scene(scene), [job.motion], solver=solver, progress=progress, resume=keep
            )[0]
        took = time.perf_counter() - began
        rollout.check()
        names = [g.name for g in scene.garments]
        positions = dict(zip(names, rollout.positions, strict=True))
        body = scene.body or load_body()
        meshes = animated_meshes(
            body, job.motion, scene.shape, scene.garments, positions, command.body
        )
        written = [] if command.out is None else write_clip(command.out, meshes, rollout.fps)
        if command.preview is not None:
            written.append(render_preview(command.preview, meshes, rollout.fps, progress=bars))
    acting = () if command.engine in ENGINES else scene.effects
    if command.json:
        told = {"notes": list(job.notes), "files": written}
        print_json(_report(rollout, acting, took) | told)
        return 0
    console.print(_summary(rollout, acting, took, command.engine))
    for note in job.notes:
        console.print(note, highlight=False, markup=False, soft_wrap=True)
    for path in written:
        console.print(
            f"wrote {path} (import at {rollout.fps:g} fps)", highlight=False, soft_wrap=True
        )
    return 0


def _check_engine(command: Simulate) -> None:
    """Fails where an engine would leave out what was asked for."""
    told = [
        f"--{name.replace('_', '-')}"
        for name, value in (
            ("accuracy", command.accuracy),
            ("wind", command.wind),
            ("self_contact", command.self_contact or None),
        )
        if value is not None
    ]
    if command.engine in ENGINES and told:
        raise FormatError(
            f"--engine {command.engine} has forces, contact and an accuracy of its own: leave"
            f" {', '.join(told)} out."
        )
    if command.engine == "bdf2" and command.accuracy is not None:
        raise FormatError("--accuracy is xpbd's: leave it out, or --engine bdf2.")


def _report(rollout: Rollout, effects: tuple[Effect, ...], took: float) -> dict[str, object]:
    frames = len(rollout.finite)
    marked = {f.name: int(np.count_nonzero(rollout.status & int(f))) for f in Status}
    return {
        "frames": frames,
        "fps": rollout.fps,
        "seconds": took,
        "effects": [type(e).__name__ for e in effects],
        "worst": rollout.worst,
        "frames_marked": {k: n for k, n in marked.items() if n},
    }


def _is_scene(word: str) -> bool:
    return pathlib.Path(word).suffix.lower() == ".toml"


# What a scene file tells itself, by the command's names.
_TOLD = (
    "start",
    "wear",
    "fabric",
    "wind",
    "self_contact",
    "fps",
    "source_fps",
    "skeleton",
    "joint_map",
)


def _scene_file(command: Simulate | Effects) -> SceneFile:
    """The scene of a file, with as many frames as are asked for.

    Raises:
        FormatError: The command says what the file has to say.
    """
    ordinary = {f.name: f.default for f in dataclasses.fields(command)}
    for name in _TOLD:
        if name in ordinary and getattr(command, name) != ordinary[name]:
            raise FormatError(
                f"{command.scene}: a scene file tells its garments, fabrics, effects and motion"
                f" itself; write it there and leave --{name.replace('_', '-')} out."
            )
    return load_scene(command.scene, frames=command.frames)


_SHOWN = {
    "strain_p99": ("strain, 99th percentile (%)", 100.0),
    "strain_max": ("strain, worst edge (%)", 100.0),
    "penetration_max": ("deepest in the skin (mm)", 1e3),
    "inside_share": ("vertices in the skin, worst frame (%)", 100.0),
    "layers_crossed": ("vertices in the wrong layer, worst frame", 1.0),
    "self_gap": ("least gap of cloth to itself (mm)", 1e3),
    "pinched": ("vertices within another limb, worst frame", 1.0),
    "residual_p99": ("residual, 99th percentile (1 = tolerance)", 1.0),
    "speed_max": ("fastest vertex (m/s)", 1.0),
}


def _summary(rollout: Rollout, effects: tuple[Effect, ...], took: float, engine: str) -> Table:
    frames = len(rollout.finite)
    acting = ", ".join(type(e).__name__ for e in effects) or f"forces and contact of {engine}"
    table = Table(
        title=f"{frames} frames in {took:.1f} s; {acting}",
        title_justify="left",
    )
    table.add_column("over all frames")
    table.add_column("worst", justify="right")
    for key, (name, scale) in _SHOWN.items():
        if key in rollout.worst:
            table.add_row(name, f"{scale * rollout.worst[key]:.3g}")
    for flag in Status:
        count = int(np.count_nonzero(rollout.status & int(flag)))
        if count:
            table.add_row(f"frames marked {flag.name}", str(count))
    return table


def price(command: Effects, console: Console) -> int:
    """Prints the price list of a scene's effects, or what is recommended."""
    if command.out is not None:
        check_writable(command.out)
    if _is_scene(command.scene):
        job = _scene_file(command)
    else:
        job = make_scene(
            command.scene,
            command.wear,
            source_fps=command.source_fps,
            skeleton=command.skeleton,
            joint_map=command.joint_map,
            frames=command.frames,
        )
    solver = ACCURACY[job.accuracy].at_rate(job.motion.fps)
    with progress_bars(console) as bars:
        rows = price_effects(
            job.scene, job.motion, solver=solver, progress=lambda d, t: bars("effects", d, t)
        )
        advice = []
        if command.recommend:
            advice = recommend_effects(
                job.scene,
                job.motion,
                solver=solver,
                tolerance=1e-3 * command.tolerance,
                rows=rows,
                progress=lambda d, t: bars("recommendation", d, t),
            )
    table = Table(
        title=f"{rows[0].frames} frames: the scene, then without each of its effects",
        caption="strain: 99th percentile; ms: a frame; Mflop: every loop's body once",
        title_justify="left",
    )
    table.add_column("without", no_wrap=True)
    for column in ("rms mm", "max mm", "strain", "inside", "ms", "Mflop"):
        table.add_column(column, justify="right")
    for r in rows:
        table.add_row(
            r.without or "nothing",
            f"{r.rms_mm:.2f}",
            f"{r.max_mm:.1f}",
            f"{r.strain_p99:.3f}",
            f"{100 * r.inside_share:.2f} %",
            f"{r.ms_per_frame:.1f}",
            f"{r.mflop:.2f}",
        )
    console.print(table)
    for note in job.notes:
        console.print(note, highlight=False, markup=False, soft_wrap=True)
    for a in advice:
        console.print(f"{a.effect}: {'needed' if a.needed else 'not needed'}. {a.why}")
    data = {
        "effects": [dataclasses.asdict(r) for r in rows],
        "recommendation": [dataclasses.asdict(a) for a in advice],
        "notes": list(job.notes),
    }
    if command.out is not None:
        write_json(command.out, data)
    if command.json:
        print_json(data)
    return 0
