"""`physxnet evaluate`: errors of methods on every action, as rows, tables and charts."""

from rich.console import Console

from ..evaluation import evaluate_dataset, row_json, summary_table
from ..viewer import write_error_report
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
        write_error_report(command.out, rows)
        console.print(f"wrote {command.out}, .md and two charts", highlight=False)
    if command.terminal.json:
        print_json([row_json(r) for r in rows])
    return 0
