"""`physxnet stress`: the table of hard cases."""

import dataclasses
import json

import jax
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from ..errors import PhysXNetError
from ..evaluation import CASES, Finding, run_case
from ..files import whole_file
from ._commands import Stress


def stress(command: Stress, console: Console) -> int:
    """Runs the cases; 0 if every bound holds, else 1."""
    unknown = [c for c in command.cases if c not in CASES]
    if unknown:
        raise PhysXNetError(f"No case {', '.join(unknown)}; there are {', '.join(CASES)}.")
    names = command.cases or tuple(CASES)
    rows: list[Finding] = []
    with Progress(console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("hard cases", total=len(names))
        for name in names:
            rows += run_case(name)
            # Every case compiles its own programs; kept, they would fill the memory.
            jax.clear_caches()
            bar.advance(task)
    table = Table(title=f"{sum(r.holds for r in rows)} of {len(rows)} bounds hold")
    for column in ("case", "quantity", "bound", "measured", "holds"):
        table.add_column(column, justify="right" if column in ("bound", "measured") else "left")
    for r in rows:
        table.add_row(
            r.case, r.quantity, f"{r.bound:g}", f"{r.measured:.3g}", "yes" if r.holds else "NO"
        )
    console.print(table)
    if command.json is not None:
        data = [{**dataclasses.asdict(r), "holds": r.holds} for r in rows]
        with whole_file(command.json) as part:
            part.write_text(json.dumps(data, indent=1) + "\n")
    return 0 if all(r.holds for r in rows) else 1
