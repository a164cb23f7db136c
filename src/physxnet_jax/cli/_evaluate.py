"""`physxnet evaluate`: errors of methods on every action, as rows, tables and charts."""

from rich.console import Console

from ..evaluation import ActionError, error_tables, evaluate_dataset, row_json, summary_table
from ..files import atomic_write
from ..viewer import draw_bars
from ._experiment_commands import Evaluate
from ._options import ray_address
from ._progress import print_json, progress_bars


def evaluate(command: Evaluate, console: Console) -> int:
    """Measures, prints the means and draws the charts."""
    with progress_bars(console) as progress:
        rows = evaluate_dataset(
            command.methods,
            command.data,
            templates=command.templates,
            split=command.split,
            train_data=command.train_data,
            out=command.out,
            times=command.times,
            ray=ray_address(command.ray),
            report=progress,
        )
    console.print(summary_table(rows), markup=False, highlight=False, soft_wrap=True)
    if command.out is not None:
        with atomic_write(command.out.with_suffix(".md")) as part:
            part.write_text(summary_table(rows) + "\n" + error_tables(rows))
        stem = command.out.with_suffix("")
        # Variants of a network are hardly distinguishable as separate bars.
        known = {r.method for r in rows}
        drawn = [r for r in rows if r.method.partition("+")[0] not in known - {r.method}]
        for what in ("vertices", "texels"):
            draw_bars(
                stem.with_name(f"{stem.name}_{what}.png"),
                [(_panel(r), r.action, r.method, getattr(r, f"rmse_{what}_mm")) for r in drawn],
                f"RMSE over {what} [mm]",
            )
        console.print(f"wrote {command.out}, .md and two charts", highlight=False)
    if command.terminal.json:
        print_json([row_json(r) for r in rows])
    return 0


def _panel(row: ActionError) -> str:
    return f"{row.template} ({row.engine})"
