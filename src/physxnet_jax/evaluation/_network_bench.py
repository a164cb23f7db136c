"""Cost and error of networks, skinning and simulators; an interrupted measurement resumes."""

import dataclasses
import json
import math
import pathlib
import statistics
from collections.abc import Callable, Iterator, Mapping, Sequence

import jax

from ..data import Sequence as Action
from ..dressing import EXTERNAL_ENGINES, Precision
from ..errors import FormatError
from ..garment import TEMPLATES, Template
from ..models import read_card
from ..motion import load_motion
from ..simulation import PRESETS
from ._cost import (
    Cost,
    mean_errors,
    network_costs,
    network_errors,
    other_costs,
    present_devices,
)
from ._method_names import GUIDED, PUSH, method_by_name, parse_method
from ._saved_rows import check_rows_file, read_rows, recorded_machine, save_rows, weights_digest

_NETWORKS = ("network", "guided")

Errors = Mapping[str, Mapping[Template, float]]
"""Mean errors [mm] by method and template."""


@dataclasses.dataclass(frozen=True)
class NetworkBench:
    """What `bench_networks` measures.

    Attributes:
        weights: Names or folders of weights, or runs, with suffixes as in `parse_method`.
        simulators: Accuracies of the simulator, ``perturbed``, and external engines.
        precisions: Precisions of the networks' arithmetic.
        batches: Frames per call of a network.
        garments: Numbers of garments that a network dresses.
        backward: Measure gradients as well.
    """

    weights: tuple[str, ...] = ("base",)
    simulators: tuple[str, ...] = ()
    precisions: tuple[Precision, ...] = ("float32",)
    batches: tuple[int, ...] = (1, 32)
    garments: tuple[int, ...] = (1, 2, 3)
    backward: bool = False


def bench_networks(
    plan: NetworkBench,
    *,
    tests: Sequence[Action] = (),
    evaluated: Errors | None = None,
    out: pathlib.Path | None = None,
    times: bool = False,
    report: Callable[[str, int, int], None],
) -> list[Cost]:
    """Measures method by method; saves the rows of each as soon as they are complete.

    Args:
        plan: What to measure.
        tests: Actions to measure errors on.
        evaluated: Errors that are known, from `evaluated_errors`; they replace those of rows.
        out: File of the rows; existing ones are kept.
        times: Only measure the times of these methods' rows again.
        report: Called with a stage, the steps done and the total.

    Returns:
        The rows of ``out``, with the new ones, sorted.

    Raises:
        FormatError: The plan is ambiguous, or rows were measured with other weights or on
            another machine.
    """
    check_rows_file(out)
    evaluated = {} if evaluated is None else evaluated
    rows = [_with_evaluated(r, evaluated) for r in _rows_to_keep(plan, out)]
    for name in plan.weights:
        # Wrong weights are reported before a long measurement starts.
        read_card(str(parse_method(name).weights))
    if times and not rows:
        raise FormatError("only existing rows can be timed again, but there are none.")
    recorded = recorded_machine(out)
    plain: Precision = "float32"
    jobs: list[tuple[str, str, Precision]] = [("lbs", "-", plain)]
    jobs.extend(
        ("engine" if s in EXTERNAL_ENGINES else "simulator", s, plain) for s in plan.simulators
    )
    jobs.extend((_kind(w), w, p) for w in plan.weights for p in plan.precisions)
    here = present_devices()
    # External engines run in their own process, on the CPU.
    work = [(d, *job) for job in jobs for d in (here[-1:] if job[0] == "engine" else here)]
    for k, (device, kind, size, precision) in enumerate(work):
        report("methods", k, len(work))
        where = (kind, pathlib.Path(size).name, precision, device.device_kind)
        # A network is measured without and with collision resolution at once.
        known = [r for r in rows if _measurement_key(r) == where]
        with jax.default_device(device):
            if times:
                # Errors are kept; a method without rows isn't measured.
                timed = _measure(kind, size, precision, _narrowed(plan, known), (), {})
                present = set(map(_key, known))
                retimed = [r for r in (timed if known else ()) if _key(r) in present]
                rows = [r for r in rows if r not in known]
                rows += [_with_errors(r, known) for r in retimed]
            else:
                for part in _unmeasured(plan, known) if kind in _NETWORKS or not known else ():
                    new = list(_measure(kind, size, precision, part, tests, evaluated))
                    # A row without the gradient gives way to the one with it.
                    replaced = set(map(_key, new))
                    rows = [r for r in rows if r not in known or _key(r) not in replaced] + new
        # Every method compiles its own programs; cached, they would use up all memory maps.
        jax.clear_caches()
        rows.sort(key=_sort_key)
        save_rows(out, rows, recorded)
    report("methods", len(work), len(work))
    return rows


def _kind(weights: str) -> str:
    return "guided" if weights.endswith(GUIDED) else "network"


def evaluated_errors(path: pathlib.Path) -> Errors:
    """Mean errors over actions against the package's simulator, from rows of `evaluate`.

    Raises:
        FormatError: The file has no such rows.
    """
    each: dict[str, dict[Template, list[float]]] = {}
    try:
        for r in json.loads(path.read_text(encoding="utf-8")):
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


def _rows_to_keep(plan: NetworkBench, out: pathlib.Path | None) -> list[Cost]:
    """Checks a plan, and reads the rows that were measured with the weights of today."""
    if not all(1 <= n <= len(TEMPLATES) for n in plan.garments):
        raise FormatError(f"garments are numbers from 1 to {len(TEMPLATES)}.")
    if any(parse_method(w).collisions for w in plan.weights):
        raise FormatError(f"networks are measured without and with {PUSH}: leave {PUSH} out.")
    digests = {pathlib.Path(w).name: weights_digest(w) for w in plan.weights}
    if len(digests) < len(plan.weights):
        raise FormatError("two networks have the same name; rename a run's folder.")
    rows = read_rows(out, Cost)
    for r in rows:
        if r.weights and digests.get(r.size, "") not in ("", r.weights):
            raise FormatError(
                f"{out}: {r.size} was measured with other weights of that name. Name another"
                " file, or delete this one."
            )
    return rows


def _measurement_key(row: Cost) -> tuple[str, str, str, str]:
    """The key that rows of one measurement share."""
    return row.method.removesuffix(PUSH), row.size, row.precision, row.device


def _key(row: Cost) -> tuple[str, int, int]:
    return row.method, row.garments, row.batch


def _narrowed(plan: NetworkBench, known: Sequence[Cost]) -> NetworkBench:
    """The plan with the garments, batches and gradients of these rows."""
    return dataclasses.replace(
        plan,
        garments=tuple(sorted({r.garments for r in known})),
        batches=tuple(sorted({r.batch for r in known})),
        backward=any(not math.isnan(r.ms_backward) for r in known),
    )


def _unmeasured(plan: NetworkBench, known: Sequence[Cost]) -> Iterator[NetworkBench]:
    """Plans for those garments and batches of a network that have no rows yet."""
    present = {
        (r.garments, r.batch) for r in known if not (plan.backward and math.isnan(r.ms_backward))
    }
    missing: dict[tuple[int, ...], list[int]] = {}
    for g in plan.garments:
        batches = tuple(b for b in plan.batches if (g, b) not in present)
        if batches:
            missing.setdefault(batches, []).append(g)
    for batches, garments in missing.items():
        yield dataclasses.replace(plan, garments=tuple(garments), batches=batches)


def _with_evaluated(row: Cost, evaluated: Errors) -> Cost:
    """A row with the current errors of its method, from `evaluated_errors`."""
    name = {"lbs": "lbs", f"network{PUSH}": f"{row.size}{PUSH}"}.get(row.method, row.size)
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
    order = ("lbs", "simulator", "engine", *_NETWORKS)
    place = order.index(row.method.removesuffix(PUSH))
    # From coarse to fine: the diagram joins the points in this order.
    finer = [*PRESETS].index(row.size) if row.size in PRESETS else -1
    which = row.size, row.precision, row.device, row.method
    return place, row.params, finer, *which, row.garments, row.batch


def _measure(
    kind: str,
    size: str,
    precision: Precision,
    plan: NetworkBench,
    tests: Sequence[Action],
    evaluated: Errors,
) -> Iterator[Cost]:
    walk = load_motion("walk", fps=30.0)
    if kind not in _NETWORKS:
        name = "lbs" if kind == "lbs" else size
        method = method_by_name(name)
        errors = evaluated.get(name)
        if errors is None:
            errors = {} if kind == "engine" else mean_errors(method, tests, TEMPLATES)
        yield from other_costs(kind, size, method, walk, errors)
        return
    inference = parse_method(size)
    # `evaluate` runs the networks in float32.
    guided = kind == "guided"
    variants = [("network", size), (f"network{PUSH}", f"{size}{PUSH}")]
    if guided:
        variants = [("guided", size)]
    found = {w: evaluated[n] for w, n in variants if precision == "float32" and n in evaluated}
    if len(found) < len(variants):
        found = network_errors(inference, tests, precision=precision, guided=guided)
    for row in network_costs(
        inference,
        walk,
        found,
        batches=plan.batches,
        garments=plan.garments,
        backward=plan.backward,
        precision=precision,
        guided=guided,
    ):
        yield dataclasses.replace(row, size=pathlib.Path(size).name)
