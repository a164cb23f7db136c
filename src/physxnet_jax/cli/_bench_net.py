"""`physxnet bench net`: cost and error of networks, skinning and simulators."""

import dataclasses
import json
import math
import pathlib
import statistics
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import jax
from rich.console import Console

from ..data import Sequence as Action, list_sequences, read_sequence
from ..dressing import EXTERNAL_ENGINES, Precision
from ..errors import FormatError
from ..evaluation import (
    Cost,
    mean_errors,
    method_by_name,
    network_costs,
    network_errors,
    other_costs,
    parse_method,
    present_devices,
)
from ..files import atomic_write, write_json
from ..garment import TEMPLATES, Template
from ..motion import load_motion
from ..simulation import PRESETS
from ..viewer import draw_work_precision
from ._experiment_commands import Bench
from ._progress import progress_bars
from ._rows import check_rows_file, kept_rows, measured_on, weights_digest


def bench_net(command: Bench, console: Console) -> int:
    """Measures method by method, and saves the rows of each as soon as they are complete."""
    check_rows_file(command.out)
    tests: list[Action] = []
    if command.data is not None:
        tests = [read_sequence(f) for f in list_sequences(command.data, "test")]
        if not tests:
            raise FormatError(f"{command.data}: no 'test' actions; build a dataset first.")
    known_errors = _evaluated(command.errors)
    if not all(1 <= n <= len(TEMPLATES) for n in command.garments):
        raise FormatError(f"--garments are numbers from 1 to {len(TEMPLATES)}.")
    names = [pathlib.Path(w).name for w in command.weights]
    if len(set(names)) < len(names):
        raise FormatError("two networks have the same name; rename a run's folder.")
    rows = kept_rows(command.out, _from_json)
    if command.times and not rows:
        raise FormatError("--times measures rows of --out again, but there are none.")
    digests = {pathlib.Path(w).name: weights_digest(w) for w in command.weights}
    for r in rows:
        if r.weights and digests.get(r.size, "") not in ("", r.weights):
            raise FormatError(
                f"{command.out}: {r.size} was measured with other weights of that name. Name"
                " another --out, or delete that file."
            )
    rows = [_with_evaluated(r, known_errors) for r in rows]
    recorded = measured_on(command.out)
    plain: Precision = "float32"
    jobs: list[tuple[str, str, Precision]] = [("lbs", "-", plain)]
    jobs.extend(
        ("engine" if s in EXTERNAL_ENGINES else "simulator", s, plain) for s in command.simulator
    )
    jobs.extend(("network", w, p) for w in command.weights for p in command.precisions)
    here = present_devices()
    # External engines run in their own process, on the CPU.
    work = [(d, *job) for job in jobs for d in (here[-1:] if job[0] == "engine" else here)]
    with progress_bars(console) as progress:
        for k, (device, kind, size, precision) in enumerate(work):
            progress("methods", k, len(work))
            name = pathlib.Path(size).name
            where = (kind, name, precision, device.device_kind)
            # A network is measured without and with collision resolution at once.
            known = [r for r in rows if _measurement_key(r) == where]
            with jax.default_device(device):
                if command.times:
                    # Errors are kept; a method without rows isn't measured.
                    timed = _measure(kind, size, precision, _narrow_command(command, known), [], {})
                    present = set(map(_key, known))
                    retimed = [r for r in (timed if known else ()) if _key(r) in present]
                    rows = [r for r in rows if r not in known]
                    rows += [_with_errors(r, known) for r in retimed]
                else:
                    for subset in (
                        _unmeasured(command, known) if kind == "network" or not known else ()
                    ):
                        rows += list(_measure(kind, size, precision, subset, tests, known_errors))
            # Every method compiles its own programs; cached, they would use up all memory maps.
            jax.clear_caches()
            rows.sort(key=_sort_key)
            if command.out is not None:
                data = [_to_json(r) for r in rows]
                write_json(command.out, {"machine": recorded, "rows": data})
        progress("methods", len(work), len(work))
    text = markdown(rows)
    console.print(text, markup=False, highlight=False, soft_wrap=True)
    if command.out is not None:
        with atomic_write(command.out.with_suffix(".md")) as part:
            part.write_text(text)
        draw_work_precision(
            command.out.with_suffix(".png"), points(rows), floors(rows), engines(rows)
        )
        console.print(f"wrote {command.out}, .md and .png", highlight=False)
    return 0


def _measurement_key(row: Cost) -> tuple[str, str, str, str]:
    """The key that rows of one measurement share."""
    return row.method.partition("+")[0], row.size, row.precision, row.device


def _key(row: Cost) -> tuple[str, int, int]:
    return row.method, row.garments, row.batch


def _narrow_command(command: Bench, known: Sequence[Cost]) -> Bench:
    """The command with the garments, batches and gradients of these rows."""
    return dataclasses.replace(
        command,
        garments=tuple(sorted({r.garments for r in known})),
        batches=tuple(sorted({r.batch for r in known})),
        backward=any(not math.isnan(r.ms_backward) for r in known),
    )


def _unmeasured(command: Bench, known: Sequence[Cost]) -> Iterator[Bench]:
    """Commands for those garments and batches of a network that have no rows yet."""
    present = {(r.garments, r.batch) for r in known}
    lacking: dict[tuple[int, ...], list[int]] = {}
    for g in command.garments:
        batches = tuple(b for b in command.batches if (g, b) not in present)
        if batches:
            lacking.setdefault(batches, []).append(g)
    for batches, garments in lacking.items():
        yield dataclasses.replace(command, garments=tuple(garments), batches=batches)


def _with_evaluated(row: Cost, evaluated: Mapping[str, dict[Template, float]]) -> Cost:
    """A row with the current errors of its method, from `physxnet evaluate`."""
    name = {"lbs": "lbs", "network+push": f"{row.size}+push"}.get(row.method, row.size)
    found = evaluated.get(name, {})
    worn = TEMPLATES[: row.garments]
    if row.precision != "float32" or not set(worn) <= found.keys():
        return row
    each = {t: round(found[t], 3) for t in worn}
    return dataclasses.replace(
        row, rmse_mm=statistics.fmean(found[t] for t in worn), rmse_each=each
    )


def _with_errors(row: Cost, known: Sequence[Cost]) -> Cost:
    """A newly timed row with the errors of the earlier rows."""
    same = [r for r in known if r.method == row.method]
    each = {t: e for r in same for t, e in r.rmse_each.items()}
    of_garments = {t: each[t] for t in TEMPLATES[: row.garments] if t in each}
    mean = statistics.fmean(of_garments.values()) if len(of_garments) == row.garments else math.nan
    # Some rows lack the errors of individual garments.
    mean = next((r.rmse_mm for r in same if r.garments == row.garments), mean)
    return dataclasses.replace(row, rmse_mm=mean, rmse_each=of_garments)


def _sort_key(row: Cost) -> tuple[object, ...]:
    """Sort key of a row, independent of the order of measurement."""
    kind = row.method.partition("+")[0]
    place = ("lbs", "simulator", "engine", "network").index(kind)
    # From coarse to fine: the diagram joins the points in this order.
    finer = [*PRESETS].index(row.size) if row.size in PRESETS else -1
    which = row.size, row.precision, row.device, row.method
    return place, row.params, finer, *which, row.garments, row.batch


def _measure(
    kind: str,
    size: str,
    precision: Precision,
    command: Bench,
    tests: list[Action],
    evaluated: Mapping[str, dict[Template, float]],
) -> Iterator[Cost]:
    walk = load_motion("walk", fps=30.0)
    if kind != "network":
        name = "lbs" if kind == "lbs" else size
        method = method_by_name(name)
        errors = evaluated.get(name)
        if errors is None:
            errors = {} if kind == "engine" else mean_errors(method, tests, TEMPLATES)
        yield from other_costs(kind, size, method, walk, errors)
        return
    inference = parse_method(size)
    # `physxnet evaluate` runs the networks in float32.
    variants = ("network", size), ("network+push", f"{size}+push")
    found = {w: evaluated[n] for w, n in variants if precision == "float32" and n in evaluated}
    if len(found) < len(variants):
        found = network_errors(inference, tests, precision=precision)
    for row in network_costs(
        inference,
        walk,
        found,
        batches=command.batches,
        garments=command.garments,
        backward=command.backward,
        precision=precision,
    ):
        yield dataclasses.replace(row, size=pathlib.Path(size).name)


def _evaluated(path: pathlib.Path | None) -> dict[str, dict[Template, float]]:
    """Mean errors [mm] over actions against our simulator, by method and template."""
    if path is None:
        return {}
    each: dict[str, dict[Template, list[float]]] = {}
    try:
        for r in json.loads(path.read_text()):
            if r["engine"] == "physxnet":
                found = each.setdefault(r["method"], {}).setdefault(r["template"], [])
                found.append(float(r["rmse_vertices_mm"]))
    except (ValueError, TypeError, KeyError):
        raise FormatError(f"{path}: no results of `physxnet evaluate`; name its --out.") from None
    return {
        m: {t: statistics.fmean(x) for t, x in of.items()}
        for m, of in each.items()
        if of.keys() == set(TEMPLATES)
    }


def points(rows: Sequence[Cost]) -> list[tuple[str, str, float, float]]:
    """Points of the diagram: a panel for each number of garments, a line for each method."""
    panels = {r.garments for r in rows if r.method.startswith("network")}
    several = len({r.device for r in rows}) > 1
    out = []
    for r in rows:
        if math.isnan(r.rmse_mm) or (panels and r.garments not in panels) or _is_noise(r):
            continue
        name = r.method if r.precision == "float32" else f"{r.method} {r.precision}"
        # A network of another family isn't a size of the same one: it gets its own line.
        name = f"{name} (paper)" if r.size == "paper" else name
        if r.method.startswith("network"):
            name += ", live" if r.batch == 1 else f", {r.batch} frames"
        if several:
            name += f", {r.device}"
        out.append((_panel(r), name, r.rmse_mm, r.ms_per_frame))
    return out


def floors(rows: Sequence[Cost]) -> dict[str, float]:
    """Noise floor of each panel [mm]: the error of a perturbed simulation."""
    return {_panel(r): r.rmse_mm for r in rows if _is_noise(r) and not math.isnan(r.rmse_mm)}


def engines(rows: Sequence[Cost]) -> dict[str, dict[str, float]]:
    """Times of external engines [ms per frame], for each panel."""
    panels = {p[0] for p in points(rows)}
    out: dict[str, dict[str, float]] = {}
    for r in rows:
        if r.method == "engine" and _panel(r) in panels:
            out.setdefault(_panel(r), {})[f"{r.size} (another cloth)"] = r.ms_per_frame
    return out


def _panel(row: Cost) -> str:
    return "one garment" if row.garments == 1 else f"{row.garments} garments"


def _is_noise(row: Cost) -> bool:
    return (row.method, row.size) == ("simulator", "perturbed")


def _to_json(row: Cost) -> dict[str, Any]:
    return {
        k: (None if math.isnan(v) else float(f"{v:.5g}")) if isinstance(v, float) else v
        for k, v in dataclasses.asdict(row).items()
    }


def _from_json(row: dict[str, Any]) -> Cost:
    values: dict[str, Any] = {k: math.nan if v is None else v for k, v in row.items()}
    return Cost(**values)


_COLUMNS = (
    "method",
    "size",
    "garments",
    "batch",
    "RMSE mm",
    "of each",
    "ms a frame",
    "network ms",
    "gradient ms",
    "cold s",
    "parameters",
    "MFLOP a frame",
    "weights MB",
    "peak MB",
    "gradient MB",
)


def markdown(rows: list[Cost]) -> str:
    """A Markdown table of the rows; it names the devices if there are several."""
    several = len({r.device for r in rows}) > 1
    columns = (*_COLUMNS[:2], *(["device"] if several else []), *_COLUMNS[2:])
    lines = [f"| {' | '.join(columns)} |", "|" + "---|" * len(columns)]
    for r in rows:
        cells = (
            r.method,
            r.size if r.precision == "float32" else f"{r.size} {r.precision}",
            *([r.device] if several else []),
            str(r.garments),
            str(r.batch),
            _number(r.rmse_mm, ".1f"),
            " / ".join(f"{x:.1f}" for x in r.rmse_each.values()) if r.garments > 1 else "",
            f"{r.ms_per_frame:.2f}",
            f"{r.ms_network:.2f}" if r.ms_network else "",
            _number(r.ms_backward, ".1f"),
            _number(r.cold_s, ".1f"),
            f"{r.params:,}" if r.params else "",
            _number(r.flops / 1e6 / r.batch, ".0f"),
            f"{r.weights_mb:.1f}" if r.weights_mb else "",
            _number(r.peak_mb, ".0f"),
            _number(r.backward_mb, ".0f"),
        )
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def _number(value: float, spec: str) -> str:
    return "" if math.isnan(value) else format(value, spec)
