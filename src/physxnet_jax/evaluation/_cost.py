"""Measured costs of methods: time, compilation, memory, FLOPs and error."""

import contextlib
import dataclasses
import functools
import itertools
import math
import pathlib
import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence as Items
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..data import Outfit, Sequence, Worn, usable_garment
from ..dressing import (
    Dresser,
    Inference,
    Precision,
    clothe,
    clothe_step,
    init_stream,
    make_dresser,
)
from ..garment import DEFAULT_KINDS, TEMPLATES, Template, tailor
from ..models import BoundGarment, Predictor, load_predictor, weights_size
from ..motion import BLOCK, Motion
from ._method_names import GUIDED, method_name
from ._methods import Guided, Method, network, skinning
from ._metrics import vertex_error
from ._saved_rows import weights_digest

# Calls are timed for at least this long [s], and at least this often.
_SECONDS, _MIN_CALLS = 2.0, 10
# Frames of a motion that is followed there and back.
_LIVE = 60


@dataclasses.dataclass(frozen=True)
class Cost:
    """Cost and error of one method.

    Attributes:
        method: ``lbs``, ``network``, ``network+push``, ``guided``, ``simulator`` or ``engine``.
        size: Name of the weights, the simulator's accuracy or the engine.
        device: Kind of the device.
        batch: Frames per call; 1 is the streaming form, one frame in and one frame out.
        garments: Number of garments, in the order shirt, trousers, A-line dress.
        rmse_mm: Mean over the test actions and these garments [mm]; NaN without data.
        ms_per_frame: Median of warm calls, from joint rotations to vertices [ms].
        ms_network: Part of it for the network, from features to maps [ms]; 0 without one.
        ms_backward: Time per frame of the vertices and the gradient of the sum of their
            squares with respect to rotations, root and the network's parameters [ms]; NaN
            if it wasn't requested.
        cold_s: Time of the first call, including compilation [s].
        params: Number of the network's parameters, with batch norm folded.
        flops: FLOPs of a call as counted by the compiler; NaN with collision resolution, strain
            limiting or a simulation, because the compiler counts a loop's body once.
        weights_mb: Size of the weights' file [MB].
        peak_mb: Memory of a call: arguments, results and temporaries [MB].
        backward_mb: Memory of a call of the gradient [MB].
        precision: Precision of the network's arithmetic.
        rmse_each: Error of each garment by template [mm], where there is data.
        weights: Checksum of the network's weights; empty if it wasn't recorded.
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
    """One device of each available kind, JAX's default first.

    Example:
        for device in present_devices():
            with jax.default_device(device):
                small = Inference(weights="small", strain_iterations=0)
                rows = list(network_costs(small, motion, {}))
    """
    found = jax.local_devices()
    # The platforms configured for JAX may exclude the CPU.
    with contextlib.suppress(RuntimeError):
        found = [*found, *jax.local_devices(backend="cpu")]
    return _first_of_each(found)


def _first_of_each(devices: Items[Any]) -> list[Any]:
    kinds = [d.device_kind for d in devices]
    return [d for k, d in enumerate(devices) if d.device_kind not in kinds[:k]]


def _default_device() -> jax.Device:
    """JAX's default device."""
    return next(iter(jnp.zeros(()).devices()))


def network_costs(
    inference: Inference,
    motion: Motion,
    errors: Mapping[str, Mapping[Template, float]],
    *,
    batches: Items[int] = (1, 32),
    garments: Items[int] = (1, 2, 3),
    backward: bool = False,
    precision: Precision = "float32",
    guided: bool = False,
) -> Iterator[Cost]:
    """Costs of a network on the default device, without and with collision resolution.

    Args:
        inference: Weights and strain limiting; costs without and with collision
            resolution are measured whatever it requests.
        motion: The motion; repeated if it is shorter than a batch.
        errors: For ``network`` and ``network+push``, or ``guided``, the mean error by template
            [mm].
        batches: Frames per call.
        garments: Numbers of garments worn together.
        backward: Measure gradients as well.
        precision: Precision of the network's arithmetic.
        guided: Measure the guided simulation instead.

    Yields:
        A row for each method, number of garments and batch.
    """
    weights = str(inference.weights)
    bare = dataclasses.replace(inference, collisions=False)
    size = pathlib.Path(str(weights) + GUIDED if guided else method_name(bare)).name
    predictor = load_predictor(weights)
    params = sum(x.size for x in jax.tree.leaves(predictor.state))
    for collisions in (False,) if guided else (False, True):
        method = "guided" if guided else "network+push" if collisions else "network"
        for number in garments:
            dresser = make_dresser(
                [tailor(DEFAULT_KINDS[t]) for t in TEMPLATES[:number]],
                method="guided" if guided else "network",
                inference=dataclasses.replace(inference, weights=predictor, collisions=collisions),
                precision=precision,
            )
            known = errors.get(method, {})
            for batch in batches:
                yield Cost(
                    method,
                    size,
                    _default_device().device_kind,
                    batch,
                    number,
                    _mean_error(known, TEMPLATES[:number]),
                    **clothing_cost(dresser, motion, batch),
                    **(_gradient(dresser, motion, batch) if backward else {}),
                    ms_network=_network(dresser, batch),
                    params=params,
                    weights_mb=weights_size(weights) / 1e6,
                    precision=precision,
                    rmse_each=_garment_errors(known, TEMPLATES[:number]),
                    weights=weights_digest(weights),
                )


def _garment_errors(errors: Mapping[Template, float], worn: Items[Template]) -> dict[str, float]:
    return {t: round(errors[t], 3) for t in worn if t in errors}


def _mean_error(errors: Mapping[Template, float], worn: Items[Template]) -> float:
    return statistics.fmean(errors.get(t, math.nan) for t in worn)


def other_costs(
    kind: str,
    size: str,
    method: Method,
    motion: Motion,
    errors: Mapping[Template, float],
) -> Iterator[Cost]:
    """Costs, summed over garments, of a method that dresses one garment at a time.

    They are measured on the default device.

    Args:
        kind: ``lbs``, ``simulator`` or ``engine``.
        size: Setting of the method.
        method: The method.
        motion: The motion.
        errors: Mean error by template [mm].

    Yields:
        A row for each number of garments.
    """
    nan = float("nan")
    times, colds = [], []
    for t in TEMPLATES:
        began = time.perf_counter()
        worn = Worn(outfit=Outfit(wear=(DEFAULT_KINDS[t],)), template=t)
        times.append(method(motion, worn).ms_per_frame)
        colds.append(time.perf_counter() - began)
        yield Cost(
            kind,
            size,
            _default_device().device_kind,
            BLOCK if kind == "lbs" else 1,
            len(times),
            _mean_error(errors, TEMPLATES[: len(times)]),
            sum(times),
            0.0,
            sum(colds),
            0,
            nan,
            0.0,
            nan,
            rmse_each=_garment_errors(errors, TEMPLATES[: len(times)]),
        )


def mean_errors(
    method: Method,
    sequences: Items[Sequence],
    templates: Items[Template],
) -> dict[Template, float]:
    """Root mean square error over vertices, averaged over actions [mm], by template."""
    out: dict[Template, float] = {}
    for t in templates:
        found = []
        for s in sequences:
            if t not in s.offsets or not usable_garment(s.meta[t]):
                continue
            worn = s.clothing(t)
            reference = skinning()(s.motion, worn).positions + s.offsets[t]
            found.append(vertex_error(method(s.motion, worn).positions, reference).rmse_mm)
        if found:
            out[t] = statistics.fmean(found)
    return out


def network_errors(
    inference: Inference,
    sequences: Items[Sequence],
    *,
    precision: Precision = "float32",
    guided: bool = False,
) -> dict[str, dict[Template, float]]:
    """`mean_errors` of a network without and with collision resolution, or guiding."""
    if guided:
        return {"guided": mean_errors(Guided(inference), sequences, TEMPLATES)}
    return {
        name: mean_errors(
            network(dataclasses.replace(inference, collisions=collisions), precision),
            sequences,
            TEMPLATES,
        )
        for name, collisions in (("network", False), ("network+push", True))
    }


def clothing_cost(
    dresser: Dresser, motion: Motion, batch: int, *, seconds: float = _SECONDS
) -> dict[str, float]:
    """Measures a call of the clothing layer, from joint rotations to vertices.

    Args:
        dresser: The garments and their network.
        motion: The motion; repeated if it is shorter than a batch.
        batch: Frames per call; 1 is the streaming form.
        seconds: Time for which calls are measured [s]. At least ten calls are measured,
            unless they take five times as long.

    Returns:
        ``ms_per_frame`` (median of warm calls), ``cold_s``, ``flops`` and ``peak_mb``, as
        in `Cost`.
    """
    pick = np.arange(batch) % motion.num_frames
    q, p = motion.rotations[pick], motion.root[pick]
    began = time.perf_counter()
    if batch == 1:
        stream = init_stream(dresser, q[0], p[0], motion.fps)
        live = jax.jit(clothe_step, static_argnames="fps")
        program = live.lower(dresser, stream, q[0], p[0], fps=motion.fps).compile()
        # There and back: cloth that is simulated must not start anew.
        there = list(zip(motion.rotations[:_LIVE], motion.root[:_LIVE], strict=True))
        poses = itertools.cycle([*there, *there[-2:0:-1]])

        def call() -> Any:
            nonlocal stream
            stream, cloth = program(dresser, stream, *next(poses))
            return stream, cloth
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
    return dresser.colliders is None and dresser.strain is None and dresser.guided is None


def _gradient(dresser: Dresser, motion: Motion, batch: int) -> dict[str, float]:
    """Cost of the gradient of the clip form, for any batch."""
    pick = np.arange(batch) % motion.num_frames
    q, p = motion.rotations[pick], motion.root[pick]
    predictor = _predictor_of(dresser)

    def total(state: Any, q: jax.Array, p: jax.Array) -> jax.Array:
        worn = dataclasses.replace(dresser, predictor=dataclasses.replace(predictor, state=state))
        squares = [jnp.sum(x * x) for x in clothe(worn, q, p, motion.fps).vertices.values()]
        return functools.reduce(jnp.add, squares)

    backward = jax.jit(jax.value_and_grad(total, argnums=(0, 1, 2)))
    program = backward.lower(predictor.state, q, p).compile()
    return {
        "ms_backward": _median(lambda: program(predictor.state, q, p)) / batch,
        "backward_mb": _peak(program) / 1e6,
    }


def _network(dresser: Dresser, batch: int) -> float:
    predictor = _predictor_of(dresser)
    templates = tuple(dict.fromkeys(w.template for w in dresser.worn))
    features = jnp.zeros(
        (batch, predictor.texel_points.rest.shape[0], predictor.config.inputs.channels), jnp.float32
    )
    worn = {w.template: w.modulation for w in dresser.worn if isinstance(w, BoundGarment)}
    known = {t: m for t, m in worn.items() if m is not None} or None
    run = jax.jit(lambda n, x, m: n.from_features(x, templates, m))
    return _median(lambda: run(predictor, features, known)) / batch


def _predictor_of(dresser: Dresser) -> Predictor:
    if dresser.predictor is None:
        raise ValueError("a dresser without a network has no network to time.")
    return dresser.predictor


def _median(call: Callable[[], Any], seconds: float = _SECONDS) -> float:
    jax.block_until_ready(call())
    laps: list[float] = []
    began = time.perf_counter()
    while len(laps) < _MIN_CALLS or time.perf_counter() - began < seconds:
        start = time.perf_counter()
        jax.block_until_ready(call())
        laps.append(1e3 * (time.perf_counter() - start))
        if time.perf_counter() - began > 5 * seconds:
            break
    return statistics.median(laps)


def _flops(program: Any) -> float:
    counted: Any = program.cost_analysis()
    # Some versions and devices return a list.
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
