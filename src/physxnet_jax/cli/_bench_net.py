"""`physxnet bench net`: cost and error of networks, skinning and simulators."""

from rich.console import Console

from ..data import list_sequences, read_sequence
from ..errors import FormatError
from ..evaluation import (
    NetworkBench,
    bench_networks,
    cost_points,
    cost_rows_table,
    engine_times,
    evaluated_errors,
    noise_floors,
)
from ..files import atomic_write
from ..viewer import draw_work_precision
from ._experiment_commands import Bench
from ._progress import progress_bars


def bench_net(command: Bench, console: Console) -> int:
    """Measures, prints the table and draws the diagram."""
    tests = []
    if command.data is not None:
        tests = [read_sequence(f) for f in list_sequences(command.data, "test")]
        if not tests:
            raise FormatError(f"{command.data}: no 'test' actions; build a dataset first.")
    plan = NetworkBench(
        weights=command.weights,
        simulators=command.simulator,
        precisions=command.precisions,
        batches=command.batches,
        garments=command.garments,
        backward=command.backward,
    )
    with progress_bars(console) as progress:
        rows = bench_networks(
            plan,
            tests=tests,
            evaluated=None if command.errors is None else evaluated_errors(command.errors),
            out=command.out,
            times=command.times,
            report=progress,
        )
    text = cost_rows_table(rows)
    console.print(text, markup=False, highlight=False, soft_wrap=True)
    if command.out is not None:
        with atomic_write(command.out.with_suffix(".md")) as part:
            part.write_text(text)
        draw_work_precision(
            command.out.with_suffix(".png"),
            cost_points(rows),
            noise_floors(rows),
            engine_times(rows),
        )
        console.print(f"wrote {command.out}, .md and .png", highlight=False)
    return 0
