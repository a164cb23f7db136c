"""`physxnet evaluate`: errors of methods on every action, as rows, tables and charts."""

import collections
import dataclasses
import math
import pathlib
from collections.abc import Callable, Mapping, Sequence as Items
from typing import Any

from rich.console import Console
from rich.table import Table

from ..data import Sequence, dataset_digest, list_sequences, read_sequence, usable_garment
from ..dressing import EXTERNAL_ENGINES
from ..errors import FormatError, PhysXNetError
from ..evaluation import (
    DIGITS,
    ActionError,
    Method,
    error_tables,
    evaluate as measure,
    means,
    method_by_name,
    nearest_frame,
    parse_method,
    pose_network,
    retime,
    summary_table,
    training_frames,
)
from ..files import atomic_write, write_json
from ..models import load_predictor
from ..simulation import PRESETS
from ..viewer import draw_bars
from ._experiment_commands import Evaluate
from ._progress import print_json, progress_bars
from ._rows import check_rows_file, kept_rows, weights_digest

# Baselines that learn from a dataset.
_TRAINED_BASELINES = ("nearest", "mlp")


def evaluate(command: Evaluate, console: Console) -> int:
    """Measures row by row, and saves each as soon as it is complete."""
    check_rows_file(command.out)
    folders = list_sequences(command.data, command.split)
    if not folders:
        raise FormatError(f"{command.data}: no '{command.split}' actions; build a dataset first.")
    twice = [n for n, k in collections.Counter(map(_label, command.methods)).items() if k > 1]
    if twice:
        raise PhysXNetError(f"two methods are named {twice[0]}; rename a run's folder.")
    rows = _read(command.out)
    if command.times and not {r.method for r in rows} & set(map(_label, command.methods)):
        raise PhysXNetError("--times measures rows of --out again; these methods have none.")
    sequences = [read_sequence(f) for f in folders]
    digests = {_label(name): _digest(name, command) for name in command.methods}
    _check_rows(rows, digests, sequences, command.out)
    with progress_bars(console) as progress:
        # A method whose rows are complete isn't loaded.
        needed = [
            name
            for name in command.methods
            if command.times or not _is_measured(_label(name), sequences, command, rows)
        ]
        methods = {_label(name): _method(name, command, progress) for name in needed}

        def show(_: str, k: int, n: int) -> None:
            progress("rows", k, n)

        if command.times:
            rows = list(retime(methods, sequences, rows, report=show))
            if command.out is not None:
                _write(command.out, rows)
        else:
            for row in measure(
                methods, sequences, templates=command.templates, done=rows, report=show
            ):
                rows.append(dataclasses.replace(row, weights=digests[row.method]))
                if command.out is not None:
                    _write(command.out, rows)
    for engine in dict.fromkeys(r.engine for r in rows):
        console.print(_summary(rows, engine))
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
    if command.json:
        print_json([_rounded(r) for r in rows])
    return 0


def _digest(name: str, command: Evaluate) -> str:
    """The checksum of a network's weights, or of the dataset that a baseline learns from.

    Empty for other methods, and if the weights or the dataset are missing.
    """
    if name in _TRAINED_BASELINES:
        root = command.train_data or command.data
        return dataset_digest(root)[0][:DIGITS] if list_sequences(root) else ""
    return weights_digest(name)


def _check_rows(
    rows: Items[ActionError],
    digests: Mapping[str, str],
    sequences: Items[Sequence],
    out: pathlib.Path | None,
) -> None:
    """Raises if a row was measured with other weights or against another simulation.

    Checksums that weren't recorded aren't compared. Training sets of baselines aren't compared
    for rows of another reference engine, because each engine may have its own training set.
    """
    data = {
        (s.meta[t]["engine"], s.name, t): str(s.meta[t].get("sha256", ""))[:DIGITS]
        for s in sequences
        for t in s.offsets
    }
    engines = {engine for engine, _, _ in data}
    for r in rows:
        other_engine = r.method in _TRAINED_BASELINES and r.engine not in engines
        pairs = (
            ("weights", r.weights, "" if other_engine else digests.get(r.method, "")),
            ("simulation", r.data, data.get((r.engine, r.action, r.template), "")),
        )
        for what, then, now in pairs:
            if then and now and then != now:
                other = "network of that name, or training set" if what == "weights" else what
                raise PhysXNetError(
                    f"{out}: {r.method} on {r.action} was measured with another {other}. Name"
                    " another --out, or delete that file."
                )


def _is_measured(
    label: str, sequences: Items[Sequence], command: Evaluate, rows: Items[ActionError]
) -> bool:
    """Whether all rows that a method can have are measured."""
    known = {(r.engine, r.action, r.template) for r in rows if r.method == label}
    return all(
        (s.meta[t]["engine"], s.name, t) in known
        for s in sequences
        for t in command.templates
        if t in s.offsets and usable_garment(s.meta[t])
    )


def _panel(row: ActionError) -> str:
    return f"{row.template} ({row.engine})"


def _read(path: pathlib.Path | None) -> list[ActionError]:
    return kept_rows(path, _from_json)


def _from_json(row: dict[str, Any]) -> ActionError:
    values: dict[str, Any] = {k: math.nan if v is None else v for k, v in row.items()}
    return ActionError(**values)


def _write(path: pathlib.Path, rows: list[ActionError]) -> None:
    write_json(path, [_rounded(r) for r in rows])


def _rounded(row: ActionError) -> Mapping[str, object]:
    # Values that earlier versions didn't measure are omitted: JSON has no NaN.
    optional = {f.name for f in dataclasses.fields(row) if f.default is not dataclasses.MISSING}
    return {
        k: float(f"{v:.5g}") if isinstance(v, float) else v
        for k, v in dataclasses.asdict(row).items()
        if not (k in optional and (v == "" or v != v))
    }


def _label(name: str) -> str:
    """The name of a method; a run has the name of its folder, without the path."""
    return pathlib.Path(name).name


def _method(name: str, command: Evaluate, progress: Callable[[str, int, int], None]) -> Method:
    if name in _TRAINED_BASELINES:
        root = command.train_data or command.data
        known = training_frames(
            [read_sequence(f) for f in list_sequences(root, "train")], command.templates
        )
        return nearest_frame(known) if name == "nearest" else pose_network(known, report=progress)
    if name not in ("lbs", "perturbed", *PRESETS, *EXTERNAL_ENGINES):
        # Checked before other methods are measured, which takes minutes.
        predictor = load_predictor(str(parse_method(name).weights))
        missing = set(command.templates) - set(predictor.config.templates)
        if missing:
            raise PhysXNetError(
                f"{name} has no decoder for {', '.join(sorted(missing))}; use --templates it has."
            )
    return method_by_name(name)


def _summary(rows: list[ActionError], engine: str) -> Table:
    table = Table(title=f"Means over actions, reference: {engine}")
    for column in ("method", "template", "RMSE mm", "inside %", "wrinkles deg", "ms a frame"):
        left = column in ("method", "template")
        table.add_column(column, justify="left" if left else "right")
    for method in dict.fromkeys(r.method for r in rows):
        for name in dict.fromkeys(r.template for r in rows):
            m = means(rows, method, name, engine)
            if m is not None:
                table.add_row(
                    method,
                    name,
                    f"{m['rmse_vertices_mm']:.1f}",
                    f"{100 * m['penetration_share']:.2f}",
                    f"{m['wrinkle_deg']:.1f}",
                    f"{m['ms_per_frame']:.1f}",
                )
    return table
