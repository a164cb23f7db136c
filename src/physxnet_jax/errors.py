"""Exceptions whose messages state what was found, what was expected and how to fix it."""

import functools
import math
import numbers
import typing

# Messages quote file contents, which can be arbitrarily long.
_MOST, _LAST = 1200, 500
# What a terminal obeys instead of showing: C0 but for line ends and tabs, DEL and C1; and what
# turns the direction of text.
_CONTROLS = {*range(32), *range(127, 160), *range(0x202A, 0x202F), *range(0x2066, 0x206A)} - {9, 10}
_ESCAPED = {c: f"\\x{c:02x}" if c < 256 else f"\\u{c:04x}" for c in _CONTROLS}


def visible(text: str) -> str:
    r"""Text with control characters as escapes: what comes from a file may carry some.

    Example:
        >>> visible("LeftArm" + chr(27) + "c")
        'LeftArm\\x1bc'
    """
    return text.translate(_ESCAPED)


class PhysXNetError(Exception):
    """Base class of errors this package raises on purpose; long messages lose their middle."""

    def __init__(self, text: str = "") -> None:
        text = visible(text)
        if len(text) > _MOST:
            text = f"{text[: _MOST - _LAST]} … {text[-_LAST:]}"
        super().__init__(text)


class MeshError(PhysXNetError, ValueError):
    """A mesh can't be used because of its shape, topology, scale or position."""


class MotionError(PhysXNetError, ValueError):
    """A motion file or clip can't be read or retargeted."""

    @classmethod
    def at(cls, path: object, line: int | None, problem: str, fix: str) -> "MotionError":
        """Builds an error that names the file, line, problem and fix, in that order."""
        place = f"{path}:{line}" if line is not None else f"{path}"
        return cls(f"{place}: {problem}. {fix}")


class FormatError(PhysXNetError, ValueError):
    """A file's name or content isn't in a supported format."""


class MissingDependencyError(PhysXNetError, ImportError):
    """An optional dependency is missing; the message names the extra that installs it."""


class DiskFullError(PhysXNetError, OSError):
    """A file doesn't fit on its disk; the message gives the file, its size and what is free."""


class OutOfMemoryError(PhysXNetError, MemoryError):
    """Memory ended; the message states for what, and what to change."""


class BusyError(PhysXNetError, RuntimeError):
    """Another process writes to a folder; the message names it and its machine."""


class SimulationError(PhysXNetError, RuntimeError):
    """A rollout ended with a status that marks its result as unreliable."""


class WeightsError(PhysXNetError, ValueError):
    """Weights, their config and their atlas are inconsistent."""


class BrokenInstallError(PhysXNetError, RuntimeError):
    """The installed jaxlib is known to compute wrong results."""


def check_numbers(owner: object, *names: str, zero: bool = False) -> None:
    """Checks that attributes of a settings object are finite and positive, or None if they may be.

    Args:
        owner: The settings object.
        *names: Attributes to check.
        zero: Whether zero is allowed.

    Raises:
        ValueError: An attribute is invalid; the message names it and its value.
    """
    for name in names:
        value = getattr(owner, name)
        if value is None and type(None) in typing.get_args(_hints(type(owner)).get(name)):
            continue
        number = isinstance(value, numbers.Real) and not isinstance(value, bool)
        x = float(typing.cast(typing.Any, value)) if number else math.nan
        if not 0.0 <= x < math.inf or (x == 0.0 and not zero):
            wanted = "a number of at least 0" if zero else "a positive number"
            raise ValueError(f"{name} is {value}, expected {wanted}")


def check_flags(owner: object, *names: str) -> None:
    """Checks that attributes of a settings object are True or False.

    Raises:
        ValueError: An attribute is something else; the message names it and its value.
    """
    for name in names:
        value = getattr(owner, name)
        if not isinstance(value, bool):
            raise ValueError(f"{name} is {value!r}, expected True or False")


def check_vector(owner: object, name: str) -> None:
    """Checks that an attribute of a settings object is three finite numbers.

    Raises:
        ValueError: It isn't; the message names it and its value.
    """
    value = getattr(owner, name)
    try:
        finite = [math.isfinite(x) for x in value]
    except TypeError:
        finite = []
    if finite != [True] * 3:
        raise ValueError(f"{name} is {value!r}, expected three finite numbers")


def check_counts(owner: object, *names: str) -> None:
    """Checks that attributes of a settings object are whole numbers of at least 1.

    Raises:
        ValueError: An attribute is invalid; the message names it and its value.
    """
    for name in names:
        value = getattr(owner, name)
        if not isinstance(value, numbers.Integral) or isinstance(value, bool) or value < 1:
            raise ValueError(f"{name} is {value}, expected a whole number of at least 1")


def check_rate(fps: object) -> None:
    """Raises an error unless frames per second are a positive number.

    Raises:
        PhysXNetError: They aren't; the message names the value.
    """
    number = isinstance(fps, numbers.Real) and not isinstance(fps, bool)
    if not number or not 0.0 < float(typing.cast(typing.Any, fps)) < math.inf:
        raise PhysXNetError(f"fps is {fps!r}, expected a positive number.")


def check_choices(owner: object, *names: str) -> None:
    """Checks that attributes of a settings object are among those of their type, a Literal.

    Raises:
        ValueError: An attribute is something else; the message names it and the choices.
    """
    hints = _hints(type(owner))
    for name in names:
        value, there = getattr(owner, name), typing.get_args(hints[name])
        if value not in there:
            raise ValueError(f"{name} is {value!r}; there are {', '.join(map(str, there))}.")


@functools.cache
def _hints(kind: type) -> dict[str, typing.Any]:
    return typing.get_type_hints(kind)


def check_type(value: object, kinds: type | tuple[type, ...], advice: str) -> None:
    """Raises an error that says what to pass unless a value is of one of some types.

    Args:
        value: The value.
        kinds: The types.
        advice: What to pass, as a sentence.
    """
    if not isinstance(value, kinds):
        shown = f"'{value}'" if isinstance(value, str) else f"an object of {type(value).__name__}"
        raise PhysXNetError(f"This is {shown}. {advice}")


__all__ = [
    "BrokenInstallError",
    "BusyError",
    "DiskFullError",
    "FormatError",
    "MeshError",
    "MissingDependencyError",
    "MotionError",
    "OutOfMemoryError",
    "PhysXNetError",
    "SimulationError",
    "WeightsError",
    "check_choices",
    "check_counts",
    "check_flags",
    "check_numbers",
    "check_rate",
    "check_type",
    "check_vector",
    "visible",
]
