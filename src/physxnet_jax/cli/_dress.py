"""`physxnet dress`, `simulate` and `demo`: load, dress, write, report."""

import contextlib
import dataclasses
import pathlib
import time
from collections.abc import Callable
from typing import Any, Literal

from rich.console import Console

from .._environment import release_programs
from ..body import load_body
from ..dressing import (
    EXTERNAL_ENGINES,
    Character,
    DressedClip,
    Inference,
    Simulation,
    Stage,
    dress,
    load_character,
    load_scene,
    write_dressed_character,
)
from ..errors import FormatError, OutOfMemoryError, PhysXNetError
from ..files import check_writable
from ..frames import IN_MEMORY, scratch_folder
from ..io import GltfFile, check_output, write_clip
from ..models import read_card
from ..motion import Motion, declared_too_fast, load_motion, read_motion, slow_subject
from ..viewer import check_preview, load_renderer, render_preview
from ._calibrate import choose
from ._clock import lap
from ._commands import Demo, Dress, Effects, Simulate
from ._options import (
    BodyOptions,
    MotionSource,
    Outfit,
    Output,
    PreviewOptions,
    changed,
    check_body,
    check_simulates,
    with_animation,
)
from ._progress import UNWRITTEN, print_json, progress_bars
from ._shape import parse_shape
from ._table import closing_table, milliseconds, report, rollout_report, rollout_table

_Progress = Callable[[str, int, int], None]

# Share of a garment inside the body beyond which a person should look at it.
_MUCH_INSIDE = 0.02
# Options that overrule a scene file.
_OVER_SCENE = ("--accuracy", "--engine", "--refine", "--substeps")


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Job:
    """Arguments of `px.dress`, and notes on the input."""

    motion: Motion | Character
    wear: Any
    shape: Any
    method: Literal["guided", "network", "lbs", "simulate"]
    inference: Inference
    simulation: Simulation
    frames: int | None
    fps: float
    start: float
    notes: tuple[str, ...] = ()
    stages: tuple[Stage, ...] = ()


def run_dress(command: Dress, console: Console, still: pathlib.Path | None = None) -> int:
    """Dresses a motion by any method."""
    _check_method(command)
    check_body(command.person, command.source)
    output = command.output
    pictures = [p for p in (output.preview, still) if p is not None]
    _check_files(output, pictures, command.picture, console)
    with progress_bars(console, lines=command.terminal.progress) as progress:
        selected = choose(command, progress)
        options: dict[str, Any] = {
            "method": command.method,
            "inference": command.inference.build(),
            "simulation": command.simulation.build(),
        }
        options |= {} if selected is None else selected.profile.options
        resumed = dataclasses.replace(options["simulation"], resume=output.unfinished)
        options["simulation"] = resumed
        job = _job(
            command.motion, command.source, command.outfit, command.person, options, progress
        )
        clip, written, _ = _run(job, output, pictures, command.picture, progress)
    if command.terminal.json:
        choice = {} if selected is None else {"picked": selected.summary}
        notes = {"notes": [*job.notes, *clip.notes, *_pierced(clip)]}
        print_json(report(clip) | notes | choice | {"files": written})
        return _code(output, clip)
    for table in closing_table(clip):
        console.print(table)
    if selected is not None:
        console.print(selected.summary, highlight=False)
    _print_end(clip, (*job.notes, *_lost(job, output), *_pierced(clip)), written, console)
    return _code(output, clip)


def _pierced(clip: DressedClip) -> tuple[str, ...]:
    """A note on each garment of which more is inside the body than cloth on a limb explains."""
    return tuple(
        f"{name}: {share:.1%} of its vertices are inside the body, {clip.worst[name][1]:.1%} in"
        f" frame {clip.worst[name][0]}: look there."
        for name, share in clip.inside.items()
        if (share or 0.0) > _MUCH_INSIDE and name in clip.worst
    )


def run_simulate(command: Simulate, console: Console) -> int:
    """Simulates a motion with garments, or a scene file."""
    check_body(command.person, command.source)
    output = command.output
    pictures = [] if output.preview is None else [output.preview]
    _check_files(output, pictures, command.picture, console)
    with progress_bars(console, lines=command.terminal.progress) as progress:
        if is_scene_file(command.scene):
            job = _scene_job(command)
        else:
            options = {"method": "simulate", "simulation": command.simulation.build()}
            job = _job(
                command.scene, command.source, command.outfit, command.person, options, progress
            )
        simulation = dataclasses.replace(job.simulation, resume=output.unfinished)
        job = dataclasses.replace(job, simulation=simulation)
        clip, written, seconds = _run(job, output, pictures, command.picture, progress)
    if command.terminal.json:
        files = {"notes": [*job.notes, *clip.notes, *_pierced(clip)], "files": written}
        print_json(rollout_report(clip, seconds) | files)
        return _code(output, clip)
    console.print(rollout_table(clip, job.simulation, seconds))
    _print_end(clip, (*job.notes, *_lost(job, output), *_pierced(clip)), written, console)
    return _code(output, clip)


def _code(output: Output, clip: DressedClip) -> int:
    """Exit code: 1 for a garment that came off, if that matters."""
    return int(output.strict and clip.came_off)


def run_demo(command: Demo, console: Console) -> int:
    """Dresses a built-in walk, and writes USD, video and image."""
    base = Dress("walk")
    job = dataclasses.replace(
        base,
        source=dataclasses.replace(base.source, frames=command.frames),
        output=dataclasses.replace(
            base.output,
            out=command.out / "demo.usdc",
            preview=command.out / "demo.mp4",
        ),
        terminal=command.terminal,
    )
    return run_dress(job, console, still=command.out / "demo.png")


def is_scene_file(word: str) -> bool:
    """Whether the argument names a scene file instead of a motion."""
    return pathlib.Path(word).suffix.lower() == ".toml"


def scene_file(command: Simulate | Effects) -> Any:
    """Loads a scene file, with the requested number of frames.

    Raises:
        FormatError: An option is given that the scene file has to state.
    """
    source = dataclasses.replace(command.source, frames=MotionSource().frames)
    given = [*changed(source), *changed(command.outfit), *changed(command.simulation)]
    given = [g for g in given if g not in _OVER_SCENE]
    if isinstance(command, Simulate):
        given += changed(command.person)
    if given:
        raise FormatError(
            f"{command.scene}: a scene file states its garments, fabrics, effects and motion;"
            f" write it there and leave {given[0]} out."
        )
    return load_scene(command.scene, frames=command.source.frames)


def _scene_job(command: Simulate) -> _Job:
    found = scene_file(command)
    options = command.simulation
    notes = found.notes
    if options.engine == "xpbd":
        # An accuracy in the command comes with its own steps.
        if options.accuracy is None and options.substeps is None:
            options = dataclasses.replace(options, substeps=found.substeps)
        options = dataclasses.replace(options, accuracy=options.accuracy or found.accuracy)
    elif found.accuracy != "standard" or found.substeps is not None:
        notes = (*notes, f"{command.scene}: its accuracy is xpbd's; {options.engine} has its own.")
    simulation = options.build()
    if options.engine in EXTERNAL_ENGINES:
        if found.lists_effects:
            raise FormatError(
                f"--engine {options.engine} defines its own forces: {command.scene} lists effects."
            )
    else:
        simulation = dataclasses.replace(simulation, effects=found.scene.effects)
    return _Job(
        motion=found.motion,
        wear=found.scene.garments,
        shape=found.scene.shape,
        method="simulate",
        inference=Inference(),
        simulation=simulation,
        frames=None,
        fps=found.motion.fps,
        start=0.0,
        notes=notes,
    )


def _job(
    word: str,
    source: MotionSource,
    outfit: Outfit,
    person: BodyOptions,
    options: dict[str, Any],
    progress: _Progress,
) -> _Job:
    """Loads the motion, and the character that it drives."""
    begun = Stage("starting", lap())
    shape = load_body().shape(**parse_shape(person.shape)) if person.shape else None
    word = with_animation(word, source)
    motion: Any = None
    if not person.animated_body:
        motion = load_motion(
            word,
            fps=source.fps,
            source_fps=source.source_fps,
            skeleton=source.skeleton,
            up=source.up,
            joint_map=source.joint_map,
            shape=shape,
        )
    custom = word if person.animated_body else person.character
    if custom is not None:
        motion = load_character(
            custom,
            fps=source.fps,
            source_fps=source.source_fps,
            mesh=person.body_mesh,
            start=source.start,
            frames=source.frames,
            motion=motion,
            joint_map=person.character_map,
            progress=progress,
        )
    defaults = {"inference": Inference(), "simulation": Simulation()}
    loaded = Stage("loading" if custom is None else "loading the character", lap())
    return _Job(
        motion=motion,
        wear=outfit.words,
        shape=shape,
        frames=source.frames,
        fps=source.fps,
        start=0.0 if custom is not None else source.start,
        notes=() if person.animated_body else _slower(word, source),
        stages=(begun, loaded),
        **(defaults | options),
    )


def _slower(word: str, source: MotionSource) -> tuple[str, ...]:
    """A note where the file's rate is known to be wrong, and isn't given."""
    given = source.source_fps is not None or source.joint_map is not None
    if given or slow_subject(word) is None:
        return ()
    note = declared_too_fast(word, read_motion(word, skeleton=source.skeleton, up=source.up))
    return () if note is None else (f"{word}: {note}",)


def _run(
    job: _Job,
    output: Output,
    pictures: list[pathlib.Path],
    look: PreviewOptions,
    progress: _Progress,
) -> tuple[DressedClip, list[pathlib.Path], float]:
    out = output.out

    def check_size(frames: int, vertices: dict[str, int]) -> None:
        release_programs()
        if out is not None:
            # There the built-in body is a skeleton with a skin; a rig is copied.
            if isinstance(job.motion, Motion):
                skinned = out.suffix.lower().startswith(".usd")
            else:
                skinned = _keeps_rig(job.motion, output)
            written = sum(n for k, n in vertices.items() if not (skinned and k == "body"))
            check_output(out, frames, written)
            # What is larger than memory is on the disk twice more until it is written.
            kept = sum(12 * frames * n for n in vertices.values() if 12 * frames * n > IN_MEMORY)
            check_writable(out, 2 * kept)

    motion = job.motion if isinstance(job.motion, Motion) else job.motion.motion
    if out is not None:
        # What is known before garments are loaded.
        check_output(out, min(motion.num_frames, job.frames or motion.num_frames))

    def report(stage: str, done: int, total: int) -> None:
        if done == 0:
            release_programs()
        progress(stage, done, total)

    if pictures:
        load_renderer()
    began = time.perf_counter()
    first = out or (pictures[0] if pictures else None)
    with contextlib.nullcontext() if first is None else scratch_folder(first.absolute().parent):
        clip = dress(
            job.motion,
            job.wear,
            method=job.method,
            inference=job.inference,
            simulation=job.simulation,
            fps=job.fps,
            start=job.start,
            frames=job.frames,
            shape=job.shape,
            include_body=output.body,
            progress=report,
            on_size=check_size,
        )
    seconds = time.perf_counter() - began
    written: list[pathlib.Path] = []
    files: list[Stage] = []
    ticks = time.perf_counter()
    if out is not None:
        written += _write(out, job.motion, clip, output)
        files.append(Stage("writing", 1e3 * (time.perf_counter() - ticks)))
    for picture in pictures:
        ticks = time.perf_counter()
        options = dataclasses.asdict(look)
        written.append(render_preview(picture, clip.meshes, clip.fps, progress=progress, **options))
        files.append(Stage("preview", 1e3 * (time.perf_counter() - ticks)))
    stages = (*clip.stages, *files)
    rest = lap() - sum(milliseconds(clip, s) for s in stages)
    stages = (*job.stages, *stages, Stage("other", max(rest, 0.0)))
    return dataclasses.replace(clip, stages=stages), written, seconds


def _write(
    out: pathlib.Path, person: Motion | Character, clip: DressedClip, output: Output
) -> list[pathlib.Path]:
    try:
        if isinstance(person, Character) and _keeps_rig(person, output):
            return [write_dressed_character(out, person, clip.garments)]
        return write_clip(out, clip.meshes, clip.fps, velocities=output.velocities)
    except MemoryError as error:
        # An archive is written by parts.
        kept = out.with_name(f"{out.stem}.kept.npz")
        write_clip(kept, clip.meshes, clip.fps)
        raise OutOfMemoryError(
            f"{out}: memory ended while it was written ({error}). The finished clip is kept as"
            f" {kept}. Write .usdc, .pc2, .mdd or .npz, or fewer --frames."
        ) from error


def _keeps_rig(person: Character, output: Output) -> bool:
    """Whether the result is a copy of the character's file, with its skin and materials."""
    out = output.out
    return bool(out and out.suffix.lower() == ".glb" and output.body and person.rig)


def _check_files(
    output: Output,
    pictures: list[pathlib.Path],
    look: PreviewOptions,
    console: Console,
) -> None:
    """Checks before the computation that all files can be written."""
    if not pictures and changed(look):
        raise PhysXNetError(f"{changed(look)[0]} is for pictures: add --preview FILE.")
    out = output.out
    if output.velocities and (out is None or not out.suffix.lower().startswith(".usd")):
        raise PhysXNetError(
            "--velocities is for USD: write a .usdc, .usd or .usda, or leave it out."
        )
    if out is not None:
        check_output(out)
    for picture in pictures:
        check_preview(picture, look.size, look.background, look.strip)
    if out is None and not pictures:
        console.print(UNWRITTEN)


def _check_method(command: Dress) -> None:
    """Rejects options that another option would make ineffective."""
    method = [] if command.method == Dress(command.motion).method else ["--method"]
    given = [*method, *changed(command.inference), *changed(command.simulation)]
    if (command.budget_ms, command.max_error_mm) != (None, None) and given:
        raise PhysXNetError(
            f"--budget-ms and --max-error-mm select the method: leave out {given[0]}."
        )
    if command.budget_ms is not None and command.max_error_mm is not None:
        raise PhysXNetError("Give either a time (--budget-ms) or an error (--max-error-mm).")
    if command.output.strict and command.method in ("network", "lbs"):
        raise PhysXNetError(
            f"--strict is for cloth that is simulated: {command.method} keeps it on."
        )
    check_simulates(command.method, command.simulation, command.outfit, command.inference.weights)
    if command.method in ("network", "guided"):
        # Before motion and garments are loaded.
        read_card(str(command.inference.weights))
    for flag in changed(command.inference):
        if command.method == "guided" and flag in ("--weights", "--tta"):
            continue
        if command.method == "guided" or (command.method != "network" and flag != "--collisions"):
            raise PhysXNetError(f"{flag} is for networks: --method {command.method} has none.")


def _lost(job: _Job, output: Output) -> tuple[str, ...]:
    """What the format of the result doesn't keep of a character."""
    out = output.out
    if out is None or not isinstance(job.motion, Character) or not output.body:
        return ()
    if _keeps_rig(job.motion, output):
        assert job.motion.rig is not None
        meshes = GltfFile(job.motion.rig.path).document.meshes
        if not any(part.targets for mesh in meshes for part in mesh.primitives):
            return ()
        return ("the character's expressions (morph targets) are kept, but not animated",)
    if job.motion.rig is not None:
        return (
            f"{out.suffix} has the character as a moving mesh, without skeleton; .glb keeps it",
        )
    return ("the person is written as a moving mesh, without skeleton and materials",)


def _print_end(
    clip: DressedClip,
    notes: tuple[str, ...],
    written: list[pathlib.Path],
    console: Console,
) -> None:
    for note in dict.fromkeys((*notes, *clip.notes)):
        console.print(note, highlight=False, markup=False, soft_wrap=True)
    for path in written:
        console.print(f"wrote {path} (import at {clip.fps:g} fps)", highlight=False, soft_wrap=True)
