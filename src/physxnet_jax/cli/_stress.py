"""`physxnet stress`: the table of hard cases."""

import dataclasses

import jax
from rich.console import Console
from rich.table import Table

from ..dressing import EXTERNAL_ENGINES
from ..errors import PhysXNetError
from ..evaluation import CASES, PEER_CASES, Finding, run_case, run_peer
from ..files import check_writable, write_json
from ..jobs import Job, run_jobs
from ._experiment_commands import Stress
from ._options import ray_address
from ._progress import print_json, progress_bars


def _run(name: str, peers: tuple[str, ...]) -> tuple[list[Finding], dict[str, dict[str, float]]]:
    """Findings of a case, and what other simulators measure in it."""
    mine, theirs = run_case(name), {}
    if name in PEER_CASES:
        theirs = {peer: run_peer(name, EXTERNAL_ENGINES[peer]) for peer in peers}
    # Every case compiles its own programs; cached, they would fill the memory.
    jax.clear_caches()
    return mine, theirs


def stress(command: Stress, console: Console) -> int:
    """Runs the cases; returns 0 if every bound holds, else 1."""
    if command.out is not None:
        check_writable(command.out)
    unknown = [c for c in command.cases if c not in CASES]
    if unknown:
        raise PhysXNetError(f"No case {', '.join(unknown)}; there are {', '.join(CASES)}.")
    names = command.cases or tuple(CASES)
    peer_results: dict[tuple[str, str], dict[str, float]] = {}
    jobs = [Job(name, _run, (name, command.peers)) for name in names]
    found: dict[str, list[Finding]] = {}
    with progress_bars(console) as progress:

        def report(_: str, done: int, total: int) -> None:
            progress("hard cases", done, total)

        for job, (mine, theirs) in run_jobs(jobs, ray=ray_address(command.ray), report=report):
            found[job.name] = mine
            peer_results |= {(peer, job.name): values for peer, values in theirs.items()}
    rows = [row for name in names for row in found[name]]
    table = Table(title=f"{sum(r.holds for r in rows)} of {len(rows)} bounds hold")
    for column in ("case", "quantity", "bound", "measured", "holds", *command.peers):
        left = column in ("case", "quantity", "holds")
        table.add_column(column, justify="left" if left else "right")

    def peer_row(r: Finding) -> dict[str, float]:
        return {
            p: peer_results[p, r.case][r.quantity]
            for p in command.peers
            if r.quantity in peer_results.get((p, r.case), {})
        }

    for r in rows:
        theirs = peer_row(r)
        table.add_row(
            r.case,
            r.quantity,
            f"{r.bound:g}",
            f"{r.measured:.3g}",
            "yes" if r.holds else "NO",
            *(f"{theirs[p]:.3g}" if p in theirs else "" for p in command.peers),
        )
    console.print(table)
    for p in command.peers:
        tried = [(r, peer_row(r)[p]) for r in rows if p in peer_row(r)]
        held = sum(value <= r.bound for r, value in tried)
        console.print(f"{p}: {held} of {len(tried)} bounds hold", highlight=False)
    data = [{**dataclasses.asdict(r), "holds": r.holds, **peer_row(r)} for r in rows]
    if command.out is not None:
        write_json(command.out, data)
    if command.terminal.json:
        print_json(data)
    return 0 if all(r.holds for r in rows) else 1
