"""Errors of named methods on a dataset on disk; an interrupted run resumes."""

import collections
import dataclasses
import functools
import pathlib
from collections.abc import Callable, Mapping, Sequence as Items

from ..data import Sequence, Where, dataset_digest, list_sequences, read_sequence, usable_garment
from ..errors import FormatError, PhysXNetError
from ..garment import Template
from ..jobs import Job, run_jobs
from ._baselines import nearest_frame, pose_network, training_frames
from ._evaluate import ActionError, evaluate, retime
from ._method_names import method_by_name
from ._methods import Method
from ._saved_rows import DIGITS, check_rows_file, read_rows, save_rows, weights_digest

# Baselines that learn from a dataset.
_TRAINED_BASELINES = ("nearest", "mlp")


def evaluate_dataset(
    names: Items[str],
    root: Where,
    *,
    templates: Items[Template],
    split: str = "test",
    train_data: Where | None = None,
    out: pathlib.Path | None = None,
    times: bool = False,
    ray: str | None = None,
    report: Callable[[str, int, int], None],
) -> list[ActionError]:
    """Measures methods on every action; saves each row as soon as it is complete.

    Args:
        names: Methods as in `method_by_name`, and ``nearest`` and ``mlp``.
        root: Folder of the reference dataset.
        templates: Garments to measure.
        split: ``train``, ``test`` or ``extra``.
        train_data: Dataset that ``nearest`` and ``mlp`` learn from; ``root`` by default.
        out: File of the rows; existing ones are kept.
        times: Only measure the times of these methods' rows again.
        ray: Address of a Ray cluster whose machines see the datasets, or ``local``, on which an
            action is a job; None for this process. Times are then those of one core.
        report: Called with a stage, the steps done and the total.

    Returns:
        The rows of ``out``, with the new ones.

    Raises:
        PhysXNetError: There are no actions, a name is unknown or ambiguous, or rows were
            measured with other weights or another simulation.
    """
    check_rows_file(out)
    folders = list_sequences(root, split)
    if not folders:
        raise FormatError(f"{root}: no '{split}' actions; build a dataset first.")
    labels = {name: _label(name) for name in names}
    twice = [n for n, k in collections.Counter(map(_label, names)).items() if k > 1]
    if twice:
        raise PhysXNetError(f"two methods are named {twice[0]}; rename a run's folder.")
    rows = read_rows(out, ActionError)
    if times and not {r.method for r in rows} & set(labels.values()):
        raise PhysXNetError("only existing rows can be timed again; these methods have none.")
    sequences = [read_sequence(f) for f in folders]
    training_root = train_data or root
    digests = {label: _digest(name, training_root) for name, label in labels.items()}
    _check_rows(rows, digests, sequences, out)
    if ray is not None:
        if times:
            raise PhysXNetError("times are compared on one machine: leave out --ray.")
        asked = (tuple(names), tuple(templates), training_root)
        jobs = [
            Job(s.name, _measure, (*asked, folder, [r for r in rows if r.action == s.name]))
            for folder, s in zip(folders, sequences, strict=True)
            if not all(_is_measured(x, [s], templates, rows) for x in labels.values())
        ]
        if not jobs:
            return rows
        old = list(rows)
        for _, new in run_jobs(jobs, ray=ray, report=report):
            rows += [dataclasses.replace(row, weights=digests[row.method]) for row in new]
            save_rows(out, rows)
        order = (tuple(templates), tuple(labels.values()), tuple(s.name for s in sequences))
        new = sorted(rows[len(old) :], key=functools.partial(_place, order))
        save_rows(out, [*old, *new])
        return [*old, *new]
    # A method whose rows are complete isn't loaded.
    methods = {
        label: _method(name, training_root, templates, report)
        for name, label in labels.items()
        if times or not _is_measured(label, sequences, templates, rows)
    }

    def show(_: str, k: int, n: int) -> None:
        report("rows", k, n)

    if times:
        rows = list(retime(methods, sequences, rows, templates=templates, report=show))
        save_rows(out, rows)
        return rows
    for row in evaluate(methods, sequences, templates=templates, done=rows, report=show):
        rows.append(dataclasses.replace(row, weights=digests[row.method]))
        save_rows(out, rows)
    return rows


def _measure(
    names: tuple[str, ...],
    templates: tuple[Template, ...],
    training_root: Where,
    folder: str,
    done: list[ActionError],
) -> list[ActionError]:
    """The rows of an action that aren't done, in a process that may keep methods for the next."""
    methods = {_label(n): _kept_method(n, training_root, templates) for n in names}
    return list(evaluate(methods, [read_sequence(folder)], templates=templates, done=done))


def _place(order: tuple[tuple[str, ...], ...], row: ActionError) -> tuple[int, ...]:
    found = (row.template, row.method, row.action)
    return tuple(names.index(x) for names, x in zip(order, found, strict=True))


@functools.cache
def _kept_method(name: str, training_root: Where, templates: tuple[Template, ...]) -> Method:
    return _method(name, training_root, templates, lambda *_: None)


def _label(name: str) -> str:
    """The name of a method; a run has the name of its folder, without the path."""
    return pathlib.Path(name).name


def _digest(name: str, training_root: Where) -> str:
    """The checksum of a network's weights, or of the dataset that a baseline learns from.

    Empty for other methods, and if the weights or the dataset are missing.
    """
    if name in _TRAINED_BASELINES:
        return dataset_digest(training_root)[0][:DIGITS] if list_sequences(training_root) else ""
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
                    " another file, or delete this one."
                )


def _is_measured(
    label: str,
    sequences: Items[Sequence],
    templates: Items[Template],
    rows: Items[ActionError],
) -> bool:
    """Whether all rows that a method can have are measured."""
    known = {(r.engine, r.action, r.template) for r in rows if r.method == label}
    return all(
        (s.meta[t]["engine"], s.name, t) in known
        for s in sequences
        for t in templates
        if t in s.offsets and usable_garment(s.meta[t])
    )


def _method(
    name: str,
    training_root: Where,
    templates: Items[Template],
    report: Callable[[str, int, int], None],
) -> Method:
    if name in _TRAINED_BASELINES:
        known = training_frames(
            [read_sequence(f) for f in list_sequences(training_root, "train")], templates
        )
        return nearest_frame(known) if name == "nearest" else pose_network(known, report=report)
    return method_by_name(name, templates)
