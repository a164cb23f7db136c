"""`physxnet calibrate`, and the selection of a method for `dress`."""

import math
import statistics
from collections.abc import Callable, Sequence

from rich.console import Console
from rich.table import Table

from ..evaluation import (
    ALONE_AND_TOGETHER,
    MethodProfile,
    Selection,
    calibrate as measure,
    calibration_file,
    choose_method,
    load_cost_table,
    worn_key,
)
from ..garment import TEMPLATES, Template, load_garment
from ._commands import Calibrate, Dress
from ._progress import print_json, progress_bars


def calibrate(command: Calibrate, console: Console) -> int:
    """Times all profiles, and prints the times with the errors."""
    if command.again:
        calibration_file().unlink(missing_ok=True)
    cost_table = load_cost_table()
    with progress_bars(console) as progress:
        times = measure(cost_table, report=lambda _, k, n: progress("timing", k, n))
    if command.terminal.json:
        profiles = [
            {"method": r.name, "ms_per_frame": times[r.name], "rmse_mm": r.rmse_mm}
            for r in cost_table
        ]
        print_json({"profiles": profiles, "files": [calibration_file()]})
        return 0
    table = Table(title="ms a frame on this machine | mm from the simulation")
    table.add_column("method")
    for name in TEMPLATES:
        table.add_column(name, justify="right")
    table.add_column("all three", justify="right")
    for profile in cost_table:
        errors = {worn_key(w): _mean_error(profile, w) for w in ALONE_AND_TOGETHER}
        cells = [
            f"{times[profile.name][k]:.2f} | {mm:.1f}" if k in times[profile.name] else "-"
            for k, mm in errors.items()
        ]
        table.add_row(profile.name, *cells)
    console.print(table)
    console.print(f"saved in {calibration_file()}", highlight=False)
    return 0


def _mean_error(profile: MethodProfile, worn: Sequence[Template]) -> float:
    known = [profile.rmse_mm[t] for t in worn if t in profile.rmse_mm]
    return statistics.fmean(known) if len(known) == len(worn) else math.nan


def choose(command: Dress, progress: Callable[[str, int, int], None]) -> Selection | None:
    """Selects a profile for the requested time or error; None if neither is given."""
    if command.budget_ms is None and command.max_error_mm is None:
        return None
    cost_table = load_cost_table()
    templates: list[Template] = [load_garment(g)[0].template for g in command.outfit.words]
    return choose_method(
        templates,
        cost_table,
        budget_ms=command.budget_ms,
        max_error_mm=command.max_error_mm,
        report=lambda _, k, n: progress("timing", k, n),
    )
