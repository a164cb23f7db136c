"""Entry point: parses the command line, runs a command and reports errors."""

import contextlib
import dataclasses
import importlib
import os
import pathlib
import re
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from inspect import cleandoc
from typing import Annotated, Any, NamedTuple, Union

import tyro
from rich.console import Console

from ..errors import BrokenInstallError, PhysXNetError
from ..files import add_inputs, keep_inputs
from ._clock import start
from ._commands import (
    Calibrate,
    Clips,
    Demo,
    Doctor,
    Dress,
    Effects,
    Export,
    ExportRest,
    Fit,
    Inspect,
    Simulate,
    Tailor,
    View,
)
from ._console import PlainConsole
from ._experiment_commands import Adapt, Bench, Dataset, Evaluate, Stress, Train


class _Handler(NamedTuple):
    """The function that runs a command, and its group in the help."""

    options: type
    module: str
    function: str
    group: str


_ANIMATE, _GARMENTS, _SIMULATE = "animate", "garments and bodies", "simulate"
_LEARN, _SYSTEM = "train and measure", "this machine"
_COMMANDS: dict[str, _Handler] = {
    "dress": _Handler(Dress, "_dress", "run_dress", _ANIMATE),
    "view": _Handler(View, "_view", "view", _ANIMATE),
    "demo": _Handler(Demo, "_dress", "run_demo", _ANIMATE),
    "export": _Handler(Export, "_export", "export", _ANIMATE),
    "inspect": _Handler(Inspect, "_garments", "inspect", _GARMENTS),
    "fit": _Handler(Fit, "_garments", "fit", _GARMENTS),
    "tailor": _Handler(Tailor, "_tailor", "run_tailor", _GARMENTS),
    "export-rest": _Handler(ExportRest, "_garments", "export_rest", _GARMENTS),
    "simulate": _Handler(Simulate, "_dress", "run_simulate", _SIMULATE),
    "effects": _Handler(Effects, "_effects", "price", _SIMULATE),
    "stress": _Handler(Stress, "_stress", "stress", _SIMULATE),
    "dataset": _Handler(Dataset, "_dataset", "dataset", _LEARN),
    "train": _Handler(Train, "_train", "train", _LEARN),
    "adapt": _Handler(Adapt, "_adapt", "run_adapt", _LEARN),
    "evaluate": _Handler(Evaluate, "_evaluate", "evaluate", _LEARN),
    "bench": _Handler(Bench, "_bench", "bench", _LEARN),
    "calibrate": _Handler(Calibrate, "_calibrate", "calibrate", _SYSTEM),
    "clips": _Handler(Clips, "_clips", "clips", _SYSTEM),
    "doctor": _Handler(Doctor, "_doctor", "doctor", _SYSTEM),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line.

    Args:
        arguments: Command-line arguments; those of the process by default.

    Returns:
        0 for success; 1 for a broken installation, or if `inspect`, `fit`, `stress`,
        `dataset check`, `doctor` or ``--strict`` finds a problem; 2 for an error in the input;
        130 if interrupted by Ctrl-C; 141 if the reader of the output closed the pipe; 143 if
        terminated.
    """
    start()
    words = list(sys.argv[1:] if arguments is None else arguments)
    try:
        if not words or words[0] in ("-h", "--help"):
            print_help(PlainConsole(highlight=False))
            return 0 if words else 2
        command = parse(words)
    except BrokenPipeError:
        return _closed_pipe()
    # Paths and names may contain brackets.
    console = PlainConsole(stderr=False, markup=False)
    errors = PlainConsole(stderr=True, soft_wrap=True)
    try:
        with _stopped_by_sigterm(), keep_inputs():
            add_inputs(*_named_files(command))
            return _run(command, console)
    except BrokenPipeError:
        return _closed_pipe()
    except (PhysXNetError, OSError) as error:
        if _flag(command, "debug"):
            raise
        errors.print(f"physxnet: {error}", style="red", markup=False)
        return 1 if isinstance(error, BrokenInstallError) else 2
    except (MemoryError, RuntimeError) as error:
        # JAX has no class for it.
        if not isinstance(error, MemoryError) and "RESOURCE_EXHAUSTED" not in str(error):
            raise
        if _flag(command, "debug"):
            raise
        kept = " Finished parts are kept for the next run." if _resumes(command) else ""
        first = (str(error) or type(error).__name__).splitlines()[0].rstrip(".")
        errors.print(
            f"physxnet: memory ended: {first}.{kept} {_LESS_MEMORY}",
            style="red",
            markup=False,
        )
        return 2
    except KeyboardInterrupt as stop:
        left = "finished parts are kept for the next run" if _resumes(command) else ""
        PlainConsole(stderr=True).print(
            f"physxnet: stopped; {left or 'nothing half-written is left'}."
        )
        return 143 if isinstance(stop, _Terminated) else 130


_LESS_MEMORY = (
    "Take fewer --frames at a time (--start), fewer or coarser garments, or a smaller batch."
)
# Options that name what is written.
_WRITTEN = ("out", "preview", "html", "write_scene", "errors", "contact_sheet")


def _closed_pipe() -> int:
    """The exit code where the reader closed the pipe; the flush at exit must not fail again."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 141


def _named_files(value: Any) -> Iterator[str]:
    """Names in a command that may be files to read; options and parts after them are left out."""
    if dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            if field.name not in _WRITTEN:
                yield from _named_files(getattr(value, field.name))
    elif isinstance(value, tuple | list):
        for item in value:
            yield from _named_files(item)
    elif isinstance(value, str | pathlib.Path):
        text = str(value)
        yield from (text, text.partition("#")[0], text.partition("#")[0].rpartition(":")[0])
        yield from re.split("[#:=,]", text)


class _Terminated(KeyboardInterrupt):
    """The process was asked to end."""


@contextlib.contextmanager
def _stopped_by_sigterm() -> Iterator[None]:
    """Lets SIGTERM end a command as Ctrl-C does, so that it removes what it leaves half-written."""

    def stop(*_: object) -> None:
        raise _Terminated

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def print_help(console: Console) -> None:
    """Prints all commands by group."""
    console.print("usage: physxnet COMMAND [OPTIONS]; physxnet COMMAND --help lists the options")
    for group in dict.fromkeys(h.group for h in _COMMANDS.values()):
        console.print(f"\n[bold]{group}[/bold]")
        for name, handler in _COMMANDS.items():
            if handler.group == group:
                line = cleandoc(handler.options.__doc__ or "").partition("\n")[0]
                console.print(f"  {name:<12} {line}", soft_wrap=True)


def _flag(command: Any, name: str) -> bool:
    """Whether a terminal flag is set; not every command has all of them."""
    return getattr(command.terminal, name, False)


def _resumes(command: object) -> bool:
    """Whether an interrupted command resumes on its next run."""
    if isinstance(command, Dress | Simulate):
        folder = command.output.unfinished
        return folder is not None and folder.is_dir()
    if isinstance(command, Evaluate | Bench):
        return command.out is not None and not command.times
    if isinstance(command, Dataset):
        return command.what == "build"
    return isinstance(command, Train | Adapt | Calibrate)


def parse(arguments: Sequence[str] | None = None) -> Any:
    """Parses a command line without running the command; exits if it is invalid."""
    words = sys.argv[1:] if arguments is None else arguments
    if sum(w.partition("=")[0] == "--wear" for w in words) > 1:
        sys.stderr.write("physxnet: --wear is given twice; name all garments after one.\n")
        raise SystemExit(2)
    requested = words[0] if words else ""
    # Only the requested command needs its examples.
    kinds = [
        Annotated[
            handler.options,
            tyro.conf.subcommand(
                name,
                description=cleandoc(handler.options.__doc__ or "") if name == requested else None,
            ),
        ]
        for name, handler in _COMMANDS.items()
    ]
    return tyro.cli(
        Union[tuple(kinds)],  # noqa: UP007  # pyright: ignore
        prog="physxnet",
        args=arguments,
        config=(tyro.conf.OmitSubcommandPrefixes, tyro.conf.OmitArgPrefixes),
    )


def _run(command: Any, console: Console) -> int:
    handler = next(h for h in _COMMANDS.values() if isinstance(command, h.options))
    is_quiet = _flag(command, "json") or _flag(command, "quiet")
    # `inspect`, `clips` and `doctor` have no result other than their output.
    if is_quiet and not isinstance(command, Inspect | Clips | Doctor):
        console = PlainConsole(quiet=True, markup=False)
    module = importlib.import_module(f".{handler.module}", __package__)
    return getattr(module, handler.function)(command, console)


if __name__ == "__main__":
    sys.exit(main())
