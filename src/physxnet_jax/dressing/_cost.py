"""What a network costs, measured: time, compilation, memory, arithmetic and error."""

import contextlib
import dataclasses
import functools
import math
import pathlib
import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence as Items
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..data import Sequence
from ..evaluation import DIGITS, Method, network, skinning, vertex_error
from ..garment import TEMPLATES, Template
from ..io import read_card, weights_size
from ..models import Predictor
from ..motion import BLOCK, Motion
from ..training import usable_garment
from ._dresser import Dresser, Precision, clothe, clothe_frame, make_dresser, start_clothing
from ._method import pushed_network

# Measured for this long at most, and this often at least.
_SECONDS, _TIMES = 2.0, 10


@dataclasses.dataclass(frozen=True)
class Cost:
    """One way to dress: what it costs and how far it is off.

    Attributes:
        method: ``lbs``, ``network``, ``network+push``, ``simulator`` or ``engine``.
        size: Name of the weights, the simulator's accuracy or the engine.
        device: Kind of what it ran on.
        batch: Frames a call; 1 is live, a frame in and a frame out.
        garments: Garments worn, in the order top, bottom, dress.
        rmse_mm: Mean over the test actions and these garments [mm]; NaN without data.
        ms_per_frame: From joint rotations to vertices, median of warm calls [ms].
        ms_network: Of it, the network from features to maps [ms]; 0 without one.
        ms_backward: The vertices and the gradient of their squares with respect to
            rotations, root and the network's parameters, a frame [ms]; NaN if not asked for.
        cold_s: The first call, compilation included [s].
        params: Numbers the network computes with, its batch norm folded away.
        flops: Of a call, as the compiler counts them; NaN with push-out or relaxation,
            whose loops it counts once.
        weights_mb: Size of the weights' file [MB].
        peak_mb: Memory of a call: arguments, results and what is between [MB].
        backward_mb: The same of the gradient.
        precision: Of the network's arithmetic.
        rmse_each: The error of each garment worn by template [mm], where there is data.
        weights: Checksum of the network's weights; empty where it wasn't noted.
    """

    method: str
    size: str
    device: str
    batch: int
    garments: int
    rmse_mm: float
    ms_per_frame: float
    ms_network: float
    cold_s: float
    params: int
    flops: float
    weights_mb: float
    peak_mb: float
    ms_backward: float = math.nan
    backward_mb: float = math.nan
    precision: str = "float32"
    rmse_each: dict[str, float] = dataclasses.field(default_factory=dict)
    weights: str = ""


def present_devices() -> list[jax.Device]:
    """One device of each kind that there is, JAX's own choice first.

    Example:
        for device in present_devices():
            with jax.default_device(device):
                rows = list(network_costs("small", load_predictor("small"), motion, {}))
    """
    found = jax.local_devices()
    # Who named a platform for JAX may have left the processor out.
    with contextlib.suppress(RuntimeError):
        found = [*found, *jax.local_devices(backend="cpu")]
    return _first_of_each(found)


def _first_of_each(devices: Items[Any]) -> list[Any]:
    kinds = [d.device_kind for d in devices]
    return [d for k, d in enumerate(devices) if d.device_kind not in kinds[:k]]


def _here() -> jax.Device:
    """The device that does what isn't told where to run."""
    return next(iter(jnp.zeros(()).devices()))


def network_costs(
    weights: str | pathlib.Path,
    predictor: Predictor,
    motion: Motion,
    errors: Mapping[str, Mapping[Template, float]],
    *,
    batches: Items[int] = (1, 32),
    garments: Items[int] = (1, 2, 3),
    backward: bool = False,
    precision: Precision = "float32",
) -> Iterator[Cost]:
    """Costs of a network on the default device, without and with push-out.

    Args:
        weights: Its name or folder.
        predictor: The network.
        motion: What the person does; repeated where it is shorter than a batch.
        errors: For ``network`` and ``network+push``, the mean error by template [mm].
        batches: Frames a call.
        garments: How many garments are worn.
        backward: Measure gradients as well.
        precision: Of the network's arithmetic.

    Yields:
        A row for each way, batch and number of garments.
    """
    size = pathlib.Path(weights).name
    params = sum(x.size for x in jax.tree.leaves(predictor.state))
    digest = str(read_card(weights)["sha256"])[:DIGITS]
    for push_out in (False, True):
        method = "network+push" if push_out else "network"
        for number in garments:
            dresser = make_dresser(
                TEMPLATES[:number], weights=predictor, push_out=push_out, precision=precision
            )
            known = errors.get(method, {})
            for batch in batches:
                yield Cost(
                    method,
                    size,
                    _here().device_kind,
                    batch,
                    number,
                    _mean(known, TEMPLATES[:number]),
                    **clothing_cost(dresser, motion, batch),
                    **(_gradient(dresser, motion, batch) if backward else {}),
                    ms_network=_network(dresser, batch),
                    params=params,
                    weights_mb=weights_size(weights) / 1e6,
                    precision=precision,
                    rmse_each=_each(known, TEMPLATES[:number]),
                    weights=digest,
                )


def _each(errors: Mapping[Template, float], worn: Items[Template]) -> dict[str, float]:
    return {t: round(errors[t], 3) for t in worn if t in errors}


def _mean(errors: Mapping[Template, float], worn: Items[Template]) -> float:
    return statistics.fmean(errors.get(t, math.nan) for t in worn)


def other_costs(
    kind: str,
    size: str,
    method: Method,
    motion: Motion,
    errors: Mapping[Template, float],
) -> Iterator[Cost]:
    """Costs of a method that dresses one garment at a time, on the default device: their sums.

    Args:
        kind: ``lbs``, ``simulator`` or ``engine``.
        size: Its setting.
        method: How it is asked.
        motion: What the person does.
        errors: Mean error by template [mm].

    Yields:
        A row for each number of garments.
    """
    nan = float("nan")
    times, colds = [], []
    for t in TEMPLATES:
        began = time.perf_counter()
        times.append(method(motion, t).ms_per_frame)
        colds.append(time.perf_counter() - began)
        yield Cost(
            kind,
            size,
            _here().device_kind,
            BLOCK if kind == "lbs" else 1,
            len(times),
            _mean(errors, TEMPLATES[: len(times)]),
            sum(times),
            0.0,
            sum(colds),
            0,
            nan,
            0.0,
            nan,
            rmse_each=_each(errors, TEMPLATES[: len(times)]),
        )


def mean_errors(
    method: Method,
    sequences: Items[Sequence],
    templates: Items[Template],
    *,
    report: Callable[[], None] | None = None,
) -> dict[Template, float]:
    """Mean over actions of the root mean square error over vertices [mm], by template."""
    out: dict[Template, float] = {}
    for t in templates:
        found = []
        for s in sequences:
            if t not in s.offsets or not usable_garment(s.meta[t]):
                continue
            reference = skinning()(s.motion, t).positions + s.offsets[t]
            found.append(vertex_error(method(s.motion, t).positions, reference).rmse_mm)
            if report is not None:
                report()
        if found:
            out[t] = statistics.fmean(found)
    return out


def network_errors(
    predictor: Predictor, sequences: Items[Sequence], report: Callable[[], None] | None = None
) -> dict[str, dict[Template, float]]:
    """`mean_errors` of a network without and with push-out."""
    return {
        "network": mean_errors(network(predictor), sequences, TEMPLATES, report=report),
        "network+push": mean_errors(pushed_network(predictor), sequences, TEMPLATES, report=report),
    }


def clothing_cost(
    dresser: Dresser, motion: Motion, batch: int, *, seconds: float = _SECONDS
) -> dict[str, float]:
    """What a call of the layer takes, from joint rotations to vertices.

    Args:
        dresser: The clothes.
        motion: What the person does; repeated where it is shorter than a batch.
        batch: Frames a call; 1 is the streaming form.
        seconds: For how long calls are timed [s]; at least ten are, but none is begun after
            five times as long.

    Returns:
        ``ms_per_frame`` (median of warm calls), ``cold_s``, ``flops`` and ``peak_mb``, as
        in `Cost`.
    """
    pick = np.arange(batch) % motion.num_frames
    q, p = motion.rotations[pick], motion.root[pick]
    began = time.perf_counter()
    if batch == 1:
        stream = start_clothing(dresser, q[0], p[0])
        live = jax.jit(clothe_frame, static_argnames="fps")
        program = live.lower(dresser, stream, q[0], p[0], fps=motion.fps).compile()

        def call() -> Any:
            return program(dresser, stream, q[0], p[0])
    else:
        whole = jax.jit(clothe, static_argnames="fps")
        program = whole.lower(dresser, q, p, fps=motion.fps).compile()

        def call() -> Any:
            return program(dresser, q, p)

    jax.block_until_ready(call())
    cold = time.perf_counter() - began
    return {
        "ms_per_frame": _median(call, seconds) / batch,
        "cold_s": cold,
        "flops": _flops(program) if _without_loops(dresser) else math.nan,
        "peak_mb": _peak(program) / 1e6,
    }


def _without_loops(dresser: Dresser) -> bool:
    return not dresser.push_out and not dresser.predictor.relaxation


def _gradient(dresser: Dresser, motion: Motion, batch: int) -> dict[str, float]:
    """Of the clip form, however many frames there are."""
    pick = np.arange(batch) % motion.num_frames
    q, p = motion.rotations[pick], motion.root[pick]

    def total(state: Any, q: jax.Array, p: jax.Array) -> jax.Array:
        worn = dataclasses.replace(
            dresser, predictor=dataclasses.replace(dresser.predictor, state=state)
        )
        squares = [jnp.sum(x * x) for x in clothe(worn, q, p, motion.fps).vertices.values()]
        return functools.reduce(jnp.add, squares)

    backward = jax.jit(jax.value_and_grad(total, argnums=(0, 1, 2)))
    program = backward.lower(dresser.predictor.state, q, p).compile()
    return {
        "ms_backward": _median(lambda: program(dresser.predictor.state, q, p)) / batch,
        "backward_mb": _peak(program) / 1e6,
    }


def _network(dresser: Dresser, batch: int) -> float:
    predictor = dresser.predictor
    templates = tuple(dict.fromkeys(w.template for w in dresser.wearables))
    features = jnp.zeros(
        (batch, predictor.surface.rest.shape[0], predictor.config.inputs.channels), jnp.float32
    )
    run = jax.jit(lambda n, x: n.from_features(x, templates))
    return _median(lambda: run(predictor, features)) / batch


def _median(call: Callable[[], Any], seconds: float = _SECONDS) -> float:
    jax.block_until_ready(call())
    laps: list[float] = []
    began = time.perf_counter()
    while len(laps) < _TIMES or time.perf_counter() - began < seconds:
        start = time.perf_counter()
        jax.block_until_ready(call())
        laps.append(1e3 * (time.perf_counter() - start))
        if time.perf_counter() - began > 5 * seconds:
            break
    return statistics.median(laps)


def _flops(program: Any) -> float:
    counted: Any = program.cost_analysis()
    # A list on some versions and devices.
    if isinstance(counted, list | tuple):
        counted = counted[0] if counted else None
    return float((counted or {}).get("flops", float("nan")))


def _peak(program: Any) -> float:
    memory = program.memory_analysis()
    if memory is None:
        return float("nan")
    return float(
        memory.argument_size_in_bytes + memory.output_size_in_bytes + memory.temp_size_in_bytes
    )
