"""`physxnet calibrate`, and what `dress` picks by it."""

import math
import statistics
from collections.abc import Callable, Sequence

from rich.console import Console
from rich.table import Table

from ..dressing import (
    ALONE_AND_TOGETHER,
    Choice,
    Rung,
    calibrate as measure,
    calibration_file,
    load_ladder,
    pick_rung,
    worn_key,
)
from ..garment import TEMPLATES, Template
from ..io import load_garment
from ._commands import Calibrate, Dress
from ._progress import print_json, progress_bars


def calibrate(command: Calibrate, console: Console) -> int:
    """Times all rungs and shows them beside their errors."""
    if command.again:
        calibration_file().unlink(missing_ok=True)
    ladder = load_ladder()
    with progress_bars(console) as progress:
        times = measure(ladder, report=lambda _, k, n: progress("timing", k, n))
    if command.json:
        rungs = [
            {"method": r.name, "ms_per_frame": times[r.name], "rmse_mm": r.rmse_mm} for r in ladder
        ]
        print_json({"rungs": rungs, "files": [calibration_file()]})
        return 0
    table = Table(title="ms a frame on this machine | mm from the simulation")
    table.add_column("method")
    for name in TEMPLATES:
        table.add_column(name, justify="right")
    table.add_column("all three", justify="right")
    for rung in ladder:
        errors = {worn_key(w): _mean_error(rung, w) for w in ALONE_AND_TOGETHER}
        cells = [
            f"{times[rung.name][k]:.2f} | {mm:.1f}" if k in times[rung.name] else "-"
            for k, mm in errors.items()
        ]
        table.add_row(rung.name, *cells)
    console.print(table)
    console.print(f"kept in {calibration_file()}", highlight=False)
    return 0


def _mean_error(rung: Rung, worn: Sequence[Template]) -> float:
    known = [rung.rmse_mm[t] for t in worn if t in rung.rmse_mm]
    return statistics.fmean(known) if len(known) == len(worn) else math.nan


def choose(command: Dress, progress: Callable[[str, int, int], None]) -> Choice | None:
    """The rung for a time or an error that was asked for; None if neither was."""
    if command.budget_ms is None and command.max_error_mm is None:
        return None
    ladder = load_ladder()
    templates: list[Template] = [load_garment(g)[0].template for g in command.wear]
    times = measure(ladder, [templates], report=lambda _, k, n: progress("timing", k, n))
    return pick_rung(
        templates,
        times,
        ladder,
        budget_ms=command.budget_ms,
        max_error_mm=command.max_error_mm,
    )
