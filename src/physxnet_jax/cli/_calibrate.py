"""`physxnet calibrate`, and what `dress` picks by it."""

from collections.abc import Callable

from rich.console import Console
from rich.table import Table

from ..dressing import (
    Choice,
    calibrate as measure,
    calibration_file,
    load_ladder,
    pick_rung,
)
from ..errors import PhysXNetError
from ..garment import TEMPLATES
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
    for rung in ladder:
        cells = [
            f"{times[rung.name][t]:.2f} | {rung.rmse_mm[t]:.1f}" if t in rung.rmse_mm else "-"
            for t in TEMPLATES
        ]
        table.add_row(rung.name, *cells)
    console.print(table)
    console.print(f"kept in {calibration_file()}", highlight=False)
    return 0


def choose(command: Dress, progress: Callable[[str, int, int], None]) -> Choice | None:
    """The rung for a time or an error that was asked for; None if neither was."""
    if command.budget_ms is None and command.max_error_mm is None:
        return None
    # Before minutes are spent on timing.
    if command.budget_ms is not None and command.max_error_mm is not None:
        raise PhysXNetError("Give either a time (--budget-ms) or an error (--max-error-mm).")
    ladder = load_ladder()
    templates = [load_garment(g)[0].template for g in command.wear]
    times = measure(ladder, report=lambda _, k, n: progress("timing", k, n))
    return pick_rung(
        templates,
        times,
        ladder,
        budget_ms=command.budget_ms,
        max_error_mm=command.max_error_mm,
    )
