"""Entry point: one sentence and a fix for every error, exit code 2."""

import dataclasses
import os
import pathlib
import sys
from collections.abc import Sequence
from inspect import cleandoc
from typing import Annotated, Any, Union

import tyro
from rich.console import Console

from ..errors import BrokenInstallError, PhysXNetError
from ._commands import (
    Calibrate,
    Clips,
    Demo,
    Doctor,
    Dress,
    Export,
    Fit,
    Inspect,
    Rest,
    View,
)
from ._doctor import doctor
from ._experiment_commands import Bench, Dataset, Evaluate, Stress, Train
from ._progress import UNWRITTEN, print_json, progress_bars
from ._shape import parse_shape
from ._simulation_commands import Effects, Simulate

_COMMANDS: dict[str, type] = {
    "dress": Dress,
    "demo": Demo,
    "doctor": Doctor,
    "clips": Clips,
    "simulate": Simulate,
    "effects": Effects,
    "bench": Bench,
    "stress": Stress,
    "dataset": Dataset,
    "train": Train,
    "evaluate": Evaluate,
    "calibrate": Calibrate,
    "export": Export,
    "inspect": Inspect,
    "fit": Fit,
    "rest": Rest,
    "view": View,
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line.

    Args:
        arguments: Words after the program's name; the process's own by default.

    Returns:
        0 for success; 1 for a broken installation, or where something is wrong with what was
        looked at (`inspect`, `fit`, `stress`, `dataset check`, `doctor`); 2 for an error of
        the user's; 130 if stopped by Ctrl-C, 141 if nobody reads any more.
    """
    command = parse(arguments)
    # Paths and names may have brackets in them.
    console = Console(stderr=False, markup=False)
    try:
        return _run(command, console)
    except PhysXNetError as error:
        if command.debug:
            raise
        Console(stderr=True, soft_wrap=True).print(f"physxnet: {error}", style="red", markup=False)
        return 1 if isinstance(error, BrokenInstallError) else 2
    except BrokenPipeError:
        # Who reads has enough; nor is there anybody to tell at the end.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except OSError as error:
        if command.debug:
            raise
        Console(stderr=True, soft_wrap=True).print(f"physxnet: {error}", style="red", markup=False)
        return 2
    except KeyboardInterrupt:
        left = "what is done is kept for the next run" if _goes_on(command) else ""
        Console(stderr=True).print(f"physxnet: stopped; {left or 'nothing half-written is left'}.")
        return 130


def _goes_on(command: object) -> bool:
    """Whether a command that was stopped goes on from there the next time."""
    if isinstance(command, Simulate):
        here = command.engine in ("xpbd", "bdf2")
        return here and (command.out or command.preview) is not None
    if isinstance(command, Evaluate | Bench | Dataset):
        return command.out is not None
    return isinstance(command, Train | Calibrate)


def parse(arguments: Sequence[str] | None = None) -> Any:
    """The command that words on a command line mean, not run; leaves if they mean none."""
    words = sys.argv[1:] if arguments is None else arguments
    asked = words[0] if words else ""
    # Examples are shown for the command that is asked about; in the list of all a line is enough.
    kinds = [
        Annotated[
            kind,
            tyro.conf.subcommand(
                name, description=cleandoc(kind.__doc__ or "") if name == asked else None
            ),
        ]
        for name, kind in _COMMANDS.items()
    ]
    return tyro.cli(
        Union[tuple(kinds)],  # noqa: UP007  # pyright: ignore
        prog="physxnet",
        args=arguments,
        config=(tyro.conf.OmitSubcommandPrefixes,),
    )


def _run(
    command: Dress
    | Demo
    | Doctor
    | Clips
    | Simulate
    | Effects
    | Bench
    | Stress
    | Dataset
    | Train
    | Evaluate
    | Export
    | Calibrate
    | Inspect
    | Fit
    | Rest
    | View,
    console: Console,
) -> int:
    told = getattr(command, "json", False) is True
    silent = told or getattr(command, "quiet", False)
    heard = Console(quiet=True, markup=False) if silent else console
    if isinstance(command, Dataset | Train | Evaluate):
        return _experiment(command, heard)
    if isinstance(command, Calibrate):
        from ._calibrate import calibrate

        return calibrate(command, heard)
    if isinstance(command, Export):
        from ._export import export

        return export(command, heard)
    if isinstance(command, Inspect | Fit):
        from ._garments import fit, inspect

        if isinstance(command, Inspect):
            return inspect(command, console)
        return fit(command, heard)
    if isinstance(command, Rest):
        from ..body import load_body
        from ._garments import rest

        shape = load_body().shape(**parse_shape(command.shape))
        return rest(command, shape, heard)
    if isinstance(command, View):
        from ._view import view

        return view(command, heard)
    if isinstance(command, Bench):
        from ._bench import bench
        from ._bench_net import bench_net

        run = bench if command.what == "sim" else bench_net
        return run(command, heard)
    if isinstance(command, Simulate | Effects):
        from ._simulate import price, simulate

        if isinstance(command, Simulate):
            return simulate(command, heard)
        return price(command, heard)
    if isinstance(command, Stress):
        from ._stress import stress

        return stress(command, heard)
    if isinstance(command, Doctor):
        return doctor(console, json=command.json)
    if isinstance(command, Clips):
        from ..garment import TEMPLATES
        from ..io import list_weights
        from ..motion import CLIPS

        if command.json:
            found = {"clips": list(CLIPS), "templates": TEMPLATES, "weights": list_weights()}
            print_json(found)
            return 0
        console.print("clips:    ", ", ".join(CLIPS))
        console.print("templates:", ", ".join(TEMPLATES))
        console.print("weights:  ", ", ".join(list_weights()))
        return 0
    if isinstance(command, Demo):
        out = command.out
        common = {"frames": command.frames, "quiet": command.quiet, "json": command.json}
        jobs = Dress("walk", out=out / "demo.usdc", preview=out / "demo.mp4", **common)
        return _dress(jobs, console, still=out / "demo.png")
    return _dress(command, console)


def _experiment(command: Dataset | Train | Evaluate, console: Console) -> int:
    if isinstance(command, Dataset):
        from ._dataset import dataset

        return dataset(command, console)
    if isinstance(command, Train):
        from ._train import train

        return train(command, console)
    from ._evaluate import evaluate

    return evaluate(command, console)


def _check_ways(command: Dress) -> None:
    """Fails where one option would have another one ignored."""
    usual = {f.name: f.default for f in dataclasses.fields(Dress)}
    told = [n for n in ("method", "weights", "accuracy") if getattr(command, n) != usual[n]]
    if (command.budget_ms, command.max_error_mm) != (None, None):
        if told or not command.push_out:
            word = told[0] if told else "no-push-out"
            raise PhysXNetError(
                f"--budget-ms and --max-error-mm pick the way to dress: leave out --{word}."
            )
    if command.budget_ms is not None and command.max_error_mm is not None:
        raise PhysXNetError("Give either a time (--budget-ms) or an error (--max-error-mm).")
    if command.accuracy != usual["accuracy"] and command.method != "simulate":
        raise PhysXNetError(
            "--accuracy is the simulator's: add --method simulate, or leave it out."
        )
    if command.weights != usual["weights"] and command.method != "network":
        raise PhysXNetError(f"--weights are a network's: --method {command.method} has none.")
    if command.start and (command.own_body or command.character is not None):
        raise PhysXNetError("--start cuts motions for the built-in body: leave it out.")


def _dress(command: Dress, console: Console, still: pathlib.Path | None = None) -> int:
    from ..body import load_body
    from ..dressing import dress, load_character
    from ..io import check_output, write_clip
    from ..motion import Motion, load_motion
    from ..viewer import check_preview, render_preview
    from ._calibrate import choose
    from ._table import closing_table, report

    # Say what can't be written before minutes are spent.
    if command.out is not None:
        check_output(command.out)
    if command.preview is not None:
        check_preview(command.preview)
    _check_ways(command)
    shape = load_body().shape(**parse_shape(command.shape)) if command.shape else None
    if command.own_body and (command.shape or command.joint_map or command.skeleton):
        raise PhysXNetError(
            "--own-body brings its shape along and needs no joints: leave out --shape,"
            " --joint-map and --skeleton."
        )
    if command.character is not None and (command.shape or command.own_body):
        raise PhysXNetError(
            "--character is a person of your own shape, moved by the file before it: leave out"
            " --shape and --own-body."
        )
    if command.body_mesh is not None and not (command.own_body or command.character):
        raise PhysXNetError("--body-mesh chooses a mesh for --own-body or --character: add one.")
    if command.character_map is not None and command.character is None:
        raise PhysXNetError("--character-map names joints of --character: add that.")
    if command.quiet or command.json:
        console = Console(quiet=True, markup=False)
    if command.out is None and command.preview is None and still is None:
        console.print(UNWRITTEN)
    with progress_bars(console) as progress:
        motion = None
        if not command.own_body:
            motion = load_motion(
                command.motion,
                fps=command.fps,
                source_fps=command.source_fps,
                skeleton=command.skeleton,
                joint_map=command.joint_map,
                shape=shape,
            )
        person = command.motion if command.own_body else command.character
        if person is not None:
            motion = load_character(
                person,
                fps=command.fps,
                source_fps=command.source_fps,
                mesh=command.body_mesh,
                frames=command.frames,
                motion=motion,
                joint_map=command.character_map,
                progress=progress,
            )
        assert motion is not None
        frames = (motion if isinstance(motion, Motion) else motion.motion).num_frames
        if command.out is not None:
            check_output(command.out, min(frames, command.frames or frames))
        ways = {
            "method": command.method,
            "accuracy": command.accuracy,
            "weights": command.weights,
            "push_out": command.push_out,
        }
        picked = choose(command, progress)
        if picked is not None:
            ways |= picked.rung.options
        clip = dress(
            motion,
            command.wear,
            fps=command.fps,
            start=command.start,
            frames=command.frames,
            shape=shape,
            include_body=command.body,
            progress=progress,
            **ways,
        )
        written: list[pathlib.Path] = []
        if command.out is not None:
            written += write_clip(command.out, clip.meshes, clip.fps)
        pictures = [p for p in (command.preview, still) if p is not None]
        for picture in pictures:
            written.append(render_preview(picture, clip.meshes, clip.fps, progress=progress))
    if command.json:
        told = {} if picked is None else {"picked": picked.told}
        print_json(report(clip) | told | {"files": written})
        return 0
    for table in closing_table(clip):
        console.print(table)
    for note in clip.notes:
        console.print(note, highlight=False, markup=False, soft_wrap=True)
    if picked is not None:
        console.print(picked.told, highlight=False)
    for path in written:
        console.print(f"wrote {path} (import at {clip.fps:g} fps)", highlight=False, soft_wrap=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
