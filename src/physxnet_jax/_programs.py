"""Compiled programs whose number and size stay bounded."""

import functools
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import jax
from jax.core import Tracer

from ._environment import few_parts

_P = ParamSpec("_P")
_T = TypeVar("_T")


def bounded_jit(
    *, static_argnames: tuple[str, ...] = (), keep: int
) -> Callable[[Callable[_P, _T]], Callable[_P, _T]]:
    """`jax.jit` for functions that are called with arrays of many shapes.

    A program is compiled in few parts where it is called outside of a transformation, and once
    there are more than ``keep`` of them, all are given up: each holds hundreds of memory maps,
    which a process has a limited number of.

    Args:
        static_argnames: As of `jax.jit`.
        keep: Most programs that are kept.

    Example:
        >>> @bounded_jit(keep=2)
        ... def double(x):
        ...     return 2 * x
        >>> [double(jax.numpy.ones(n)).shape for n in (1, 2, 3)]
        [(1,), (2,), (3,)]
    """

    def wrap(function: Callable[_P, _T]) -> Callable[_P, _T]:
        # Only the outermost of nested functions can have options.
        within: Any = jax.jit(function, static_argnames=static_argnames)

        @functools.cache
        def bounded() -> Any:
            options = few_parts() if jax.default_backend() == "cpu" else None
            return jax.jit(function, static_argnames=static_argnames, compiler_options=options)

        @functools.wraps(function)
        def call(*args: _P.args, **kwargs: _P.kwargs) -> _T:
            if any(isinstance(x, Tracer) for x in jax.tree.leaves((args, kwargs))):
                return within(*args, **kwargs)
            outside = bounded()
            out = outside(*args, **kwargs)
            if outside._cache_size() > keep:
                outside.clear_cache()
            return out

        return call

    return wrap
