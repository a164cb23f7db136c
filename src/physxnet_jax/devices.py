"""Devices and processes: one mesh, over which batches are split and all else is repeated."""

import concurrent.futures
import contextlib
import functools
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, ParamSpec, TypeVar

import jax
import jax.core
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from .errors import PhysXNetError

_P = ParamSpec("_P")
_S = TypeVar("_S")
_T = TypeVar("_T")
_AXIS = "batch"
# Variables in which a launcher says how many processes it started: srun, mpirun.
_LAUNCHERS = ("SLURM_STEP_NUM_TASKS", "OMPI_COMM_WORLD_SIZE")


def join_processes(
    coordinator: str | None = None,
    num_processes: int | None = None,
    process_id: int | None = None,
    *,
    patience: int = 60,
) -> int:
    """Joins the processes of a run, which may be on several machines.

    Call it before anything is computed. Without arguments, Slurm and Open MPI say what the
    processes are; a process that was started alone stays alone.

    Args:
        coordinator: Address of the first process, ``HOST:PORT``.
        num_processes: Number of processes.
        process_id: This one's number, from 0.
        patience: A process that hasn't been heard of for so long has ended [s].

    Returns:
        This process's number.

    Raises:
        PhysXNetError: Some of the three are missing, or the processes didn't meet.
    """
    given = (coordinator, num_processes, process_id)
    launched = any(int(os.environ.get(name, "1")) > 1 for name in _LAUNCHERS)
    if given == (None, None, None) and not launched:
        return 0
    if None in given and given != (None, None, None):
        raise PhysXNetError(
            "coordinator, num_processes and process_id belong together: give all three, or none"
            " under Slurm or Open MPI."
        )
    try:
        jax.config.update("jax_cpu_collectives_implementation", "gloo")
        jax.distributed.initialize(
            coordinator, num_processes, process_id, heartbeat_timeout_seconds=patience
        )
    except (RuntimeError, ValueError) as error:
        raise PhysXNetError(f"The processes didn't meet at {coordinator}: {error}") from error
    if jax.default_backend() == "cpu":
        # A process that loads a program from the cache may wait for ever in XLA once others joined.
        jax.config.update("jax_enable_compilation_cache", False)
    return jax.process_index()


def make_mesh(batch: int, devices: int | None = None, *, local: bool = False) -> Mesh:
    """A mesh of devices that share a batch equally.

    Args:
        batch: Size of the batch.
        devices: Number of devices of each process; if None, as many as divide the batch.
        local: Of this process alone.

    Raises:
        PhysXNetError: Fewer devices, or they don't divide the batch.
    """
    own = len(jax.local_devices())
    processes = 1 if local else jax.process_count()
    if devices is None:
        usable = [k for k in range(1, own + 1) if batch % (k * processes) == 0]
        devices = max(usable, default=1)
    if not 1 <= devices <= own:
        raise PhysXNetError(f"{devices} devices: this machine has {own}.")
    if batch % (devices * processes):
        raise PhysXNetError(
            f"a batch of {batch} can't be split among {devices * processes} devices; choose a"
            " number that divides it."
        )
    chosen = []
    for process in [jax.process_index()] if local else range(processes):
        chosen += [d for d in jax.devices() if d.process_index == process][:devices]
    return Mesh(np.asarray(chosen), (_AXIS,))


def repeated(mesh: Mesh, tree: Any) -> Any:
    """Arrays of a pytree, whole on every device."""
    sharding = NamedSharding(mesh, PartitionSpec())
    return jax.tree.map(
        lambda x: jax.make_array_from_process_local_data(sharding, np.asarray(x)), tree
    )


def at_home(tree: Any) -> Any:
    """Arrays of a pytree that are whole on every device, on this process's first device."""
    return jax.device_put(jax.device_get(tree))


def own_rows(count: int) -> slice:
    """Rows of a batch that this process loads."""
    each = count // jax.process_count()
    return slice(each * jax.process_index(), each * (jax.process_index() + 1))


def split(mesh: Mesh, rows: Mapping[str, np.ndarray]) -> dict[str, jax.Array]:
    """A batch over all devices, from the rows that this process has loaded."""
    sharding = NamedSharding(mesh, PartitionSpec(_AXIS))
    return {k: jax.make_array_from_process_local_data(sharding, v) for k, v in rows.items()}


def _default_device() -> jax.Device:
    chosen = jax.config.jax_default_device  # pyright: ignore[reportAttributeAccessIssue]
    if chosen is None:
        return jax.local_devices()[0]
    return jax.local_devices(backend=chosen)[0] if isinstance(chosen, str) else chosen


@contextlib.contextmanager
def on_processor() -> Iterator[None]:
    """Within it, the processor is JAX's default device.

    For what is prepared once: hundreds of small programs, whose compilation for an accelerator
    takes a minute.
    """
    try:
        processor = jax.local_devices(backend="cpu")[0]
    # JAX_PLATFORMS may leave it out.
    except RuntimeError:
        yield
        return
    with jax.default_device(processor):
        yield


def side_by_side(function: Callable[[_S], _T], items: Sequence[_S]) -> list[_T]:
    """Prepares items in threads: XLA compiles without Python's lock.

    Args:
        function: Computes on the processor, from concrete arrays.
        items: What it is called with.
    """
    if len(items) < 2:
        return [function(item) for item in items]

    def run(item: _S) -> _T:
        with on_processor():
            return function(item)

    with concurrent.futures.ThreadPoolExecutor(min(len(items), os.cpu_count() or 1)) as pool:
        return list(pool.map(run, items))


def prepared_on_processor(function: Callable[_P, _T]) -> Callable[_P, _T]:
    """Makes a function compute on the processor; arrays of its result go to the default device.

    The arrays stay uncommitted: they can be used together with those of any device.
    """

    @functools.wraps(function)
    def wrapped(*args: _P.args, **kwargs: _P.kwargs) -> _T:
        device = _default_device()
        with on_processor():
            if _default_device() == device:
                return function(*args, **kwargs)
            result = function(*args, **kwargs)
        return jax.tree.map(_copied, result)

    return wrapped


def _copied(x: Any) -> Any:
    """An array on the default device."""
    if isinstance(x, jax.core.Tracer) or not isinstance(x, jax.Array):
        return x
    return jax.device_put(np.asarray(x))
