"""The least time that a program could take: its operations and bytes over measured ceilings."""

import dataclasses
import math
import statistics
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

# Results that cost no arithmetic.
_MOVES = frozenset(
    "broadcast_in_dim concatenate convert_element_type copy gather iota pad reshape rev scatter"
    " slice dynamic_slice dynamic_update_slice squeeze transpose stop_gradient".split()
)


@dataclasses.dataclass(frozen=True)
class Work:
    """What a program does.

    Attributes:
        operations: Results of arithmetic, one each; products of matrices two a term.
        bytes: What gathers read and scatters write; all else is taken to stay on the chip.
    """

    operations: float = 0.0
    bytes: float = 0.0

    def plus(self, other: "Work", times: float = 1.0) -> "Work":
        """Both, the other one several times."""
        return Work(self.operations + times * other.operations, self.bytes + times * other.bytes)


def work_of(function: Callable[..., Any], *arguments: Any, **static: Any) -> Work:
    """Counts the work of a call from its jaxpr; loops of unknown length count once."""
    closed = jax.make_jaxpr(lambda *a: function(*a, **static))(*arguments)
    return _work(closed.jaxpr)


def _work(jaxpr: Any) -> Work:
    total = Work()
    for eqn in jaxpr.eqns:
        name = eqn.primitive.name
        inner = [
            sub
            for value in eqn.params.values()
            for item in (value if isinstance(value, tuple | list) else (value,))
            for sub in [getattr(item, "jaxpr", item)]
            if hasattr(sub, "eqns")
        ]
        if inner:
            times = eqn.params.get("length", 1) if name == "scan" else 1
            for sub in inner:
                total = total.plus(_work(sub), times)
            continue
        out = sum(v.aval.size for v in eqn.outvars)
        if name in ("gather", "scatter", "scatter-add", "dynamic_slice"):
            moved = eqn.invars[-1] if name.startswith("scatter") else eqn.outvars[0]
            total = total.plus(Work(0.0, moved.aval.size * moved.aval.dtype.itemsize))
        if name == "dot_general":
            (contracted, _), _ = eqn.params["dimension_numbers"]
            terms = math.prod(eqn.invars[0].aval.shape[k] for k in contracted)
            total = total.plus(Work(2.0 * out * terms))
        elif name not in _MOVES:
            total = total.plus(Work(float(out)))
    return total


@dataclasses.dataclass(frozen=True)
class Ceilings:
    """Measured rates of a device.

    Attributes:
        bytes_per_s: Reads and writes of an array that fits no cache.
        float32_per_s: Multiplications and additions outside matrix units, each counts.
        bfloat16_per_s: The same within products of large matrices.
    """

    bytes_per_s: float
    float32_per_s: float
    bfloat16_per_s: float

    def seconds(self, work: Work) -> float:
        """The least time of float32 arithmetic without matrix units."""
        return max(work.operations / self.float32_per_s, work.bytes / self.bytes_per_s)


def median_seconds(call: Callable[[], Any], repeats: int = 10) -> float:
    """Median time of a call, after a first one that compiles."""
    jax.block_until_ready(call())
    laps = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(call())
        laps.append(time.perf_counter() - start)
    return statistics.median(laps)


def measure_ceilings(size: int = 1 << 28, matrix: int = 8192) -> Ceilings:
    """Measures a copy, a chain of multiplications and additions, and a product of matrices."""
    key = jax.random.key(0)
    x = jax.random.uniform(key, (size,))
    halve, multiply = jax.jit(lambda a: a * 0.5), jax.jit(jnp.matmul)
    copied = median_seconds(lambda: halve(x))
    terms = 512

    @jax.jit
    def chain(a: jax.Array) -> jax.Array:
        for _ in range(terms):
            a = a * 0.999 + 0.001
        return a

    small = x[: size // 16]
    chained = median_seconds(lambda: chain(small))
    a = jax.random.normal(key, (matrix, matrix), jnp.bfloat16)
    product = median_seconds(lambda: multiply(a, a))
    return Ceilings(
        8.0 * size / copied, 2.0 * terms * small.size / chained, 2.0 * matrix**3 / product
    )
