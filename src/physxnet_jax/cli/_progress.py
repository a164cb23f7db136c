"""Output: progress bars with the remaining time, and JSON."""

import contextlib
import json
import sys
from collections.abc import Callable, Iterator

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from ..files import json_text

UNWRITTEN = "nothing will be written: name a file with -o or --preview"
"""Printed before the computation if its result would be lost."""


@contextlib.contextmanager
def progress_bars(
    console: Console, *, lines: bool = False
) -> Iterator[Callable[[str, int, int], None]]:
    """Yields a function that takes a stage, the steps done and the number of steps.

    Args:
        console: Where bars are drawn, if it is a terminal.
        lines: Print lines of JSON on stderr instead.
    """
    if lines:
        yield _print_line
        return
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.completed}/{task.total}"),
        TimeRemainingColumn(),
    )
    with Progress(
        *columns, console=console, transient=True, disable=not console.is_terminal
    ) as bar:
        tasks: dict[str, TaskID] = {}

        def progress(name: str, done: int, total: int) -> None:
            if name not in tasks:
                tasks[name] = bar.add_task(name, total=total)
            bar.update(tasks[name], completed=done, total=total)

        yield progress


def _print_line(name: str, done: int, total: int) -> None:
    line = json.dumps({"stage": name, "done": done, "total": total})
    print(line, file=sys.stderr, flush=True)  # noqa: T201


def print_json(values: object) -> None:
    """Prints JSON without wrapping it to the width of the terminal."""
    print(json_text(values))  # noqa: T201
