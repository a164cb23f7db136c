"""Lists of independent jobs, in this process or on a Ray cluster."""

import dataclasses
import os
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from .errors import PhysXNetError

LOCAL = "local"
"""In place of a cluster's address: join the one that runs on this machine, or start one."""

Report = Callable[[str, int, int], None]
"""Takes a message, the jobs done, and their number."""

# How often Ray starts a job again whose machine or process died.
_LOSSES = 5


@dataclasses.dataclass(frozen=True)
class Job:
    """A call that depends on nothing but its arguments.

    Attributes:
        name: What to call it in reports.
        function: A function of a module. It may run again after its machine was lost, so what it
            writes has to be the same each time.
        arguments: Its arguments; on a cluster they are pickled.
    """

    name: str
    function: Callable[..., Any]
    arguments: tuple[Any, ...] = ()


def run_jobs(
    jobs: Sequence[Job], *, ray: str | None = None, report: Report | None = None
) -> Iterator[tuple[Job, Any]]:
    """Runs jobs, and yields each with its result as it finishes.

    In this process they run one after another, and an error ends them. On Ray each takes one core,
    and one GPU if the cluster has any;
    lost workers and machines are replaced, a job that raises is tried once more, and those that
    raise twice are reported together when all others are done.

    Args:
        jobs: The jobs.
        ray: Address of a Ray cluster, or ``local``; None for this process.
        report: Called before the first job and after each one.

    Raises:
        PhysXNetError: Ray isn't installed or the cluster isn't there, or jobs failed on it.
    """
    if ray is None:
        for k, job in enumerate(jobs):
            if report is not None:
                report(job.name, k, len(jobs))
            yield job, job.function(*job.arguments)
    else:
        yield from _on_ray(jobs, ray, report)
    if report is not None:
        report("done", len(jobs), len(jobs))


@dataclasses.dataclass(frozen=True)
class _Failure:
    text: str


def _attempt(function: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
    """Runs a job, a second time if it raises."""
    text = ""
    for _ in range(2):
        try:
            return function(*arguments)
        except Exception:
            text = traceback.format_exc()
    return _Failure(text)


def _on_ray(jobs: Sequence[Job], address: str, report: Report | None) -> Iterator[tuple[Job, Any]]:
    try:
        import ray
        from ray.exceptions import RayError
    except ImportError:
        raise PhysXNetError(
            "Ray isn't installed: pip install 'physxnet-jax[cluster]', or leave out --ray."
        ) from None
    joined = ray.is_initialized()
    if not joined:
        _join(ray, address)
    # XLA starts a thread for each core of the machine, but a job has one core.
    environment = {"env_vars": {"NPROC": "1"}}
    # With accelerators in the cluster a job is for one of them.
    cards = 1 if ray.cluster_resources().get("GPU", 0) else 0
    run = ray.remote(
        num_cpus=1,
        num_gpus=cards,
        max_retries=_LOSSES,
        retry_exceptions=False,
        runtime_env=environment,
    )(_attempt)
    waiting = {run.remote(job.function, job.arguments): job for job in jobs}
    failed: list[str] = []
    try:
        while waiting:
            if report is not None:
                report("on Ray", len(jobs) - len(waiting), len(jobs))
            (ready,), _ = ray.wait(list(waiting), num_returns=1)
            job = waiting.pop(ready)
            try:
                result = ray.get(ready)
            except RayError as error:
                result = _Failure(str(error))
            if isinstance(result, _Failure):
                failed.append(f"{job.name}: {result.text.strip().splitlines()[-1]}")
            else:
                yield job, result
    finally:
        for reference in waiting:
            ray.cancel(reference, force=True)
        if not joined:
            ray.shutdown()
    if failed:
        raise PhysXNetError(
            f"{len(failed)} of {len(jobs)} jobs failed twice; the others are done. The same"
            " command tries them again:\n  " + "\n  ".join(failed)
        )


def _join(ray: Any, address: str) -> None:
    # What later versions of Ray do anyway; this one warns that it doesn't yet.
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    try:
        with warnings.catch_warnings():
            # Ray starts its programs, which run nothing of JAX, by forking.
            warnings.filterwarnings("ignore", ".*os.fork.*", RuntimeWarning)
            place = None if address == LOCAL else address
            ray.init(place, log_to_driver=False, logging_level="error")
    except (ConnectionError, ValueError, RuntimeError) as error:
        raise PhysXNetError(f"No Ray cluster at {address}: {error}") from error
