"""Exceptions whose text says what was got, what was expected and how to fix it."""

import math
import numbers

# Files are quoted in errors, and may hold anything at any length.
_MOST, _LAST = 1200, 500


class PhysXNetError(Exception):
    """Base of every error this package raises on purpose; of a long text the middle is left out."""

    def __init__(self, text: str = "") -> None:
        if len(text) > _MOST:
            text = f"{text[: _MOST - _LAST]} … {text[-_LAST:]}"
        super().__init__(text)


class MeshError(PhysXNetError, ValueError):
    """A mesh can't be used as it is (shape, topology, scale, position)."""


class MotionError(PhysXNetError, ValueError):
    """A motion file or clip can't be read or retargeted."""

    @classmethod
    def at(cls, path: object, line: int | None, problem: str, fix: str) -> "MotionError":
        """Error text with file, line and fix, in that order."""
        place = f"{path}:{line}" if line is not None else f"{path}"
        return cls(f"{place}: {problem}. {fix}")


class FormatError(PhysXNetError, ValueError):
    """A file's name or content isn't of a format this package knows."""


class MissingDependencyError(PhysXNetError, ImportError):
    """An optional library is needed; the text says which extra installs it."""


class SimulationError(PhysXNetError, RuntimeError):
    """A rollout ended with a status that says its result can't be trusted."""


class WeightsError(PhysXNetError, ValueError):
    """Weights, their config or their atlas don't fit together."""


class BrokenInstallError(PhysXNetError, RuntimeError):
    """The installed jaxlib is known to compute wrong numbers."""


def check_numbers(owner: object, *names: str, zero: bool = False) -> None:
    """Fails unless attributes of settings are finite and positive; None is left out.

    Args:
        owner: The settings.
        *names: Of the attributes.
        zero: Whether zero will do.

    Raises:
        ValueError: One isn't; attribute and value are named.
    """
    for name in names:
        value = getattr(owner, name)
        if value is None:
            continue
        number = isinstance(value, numbers.Real) and math.isfinite(value)
        if not number or value < 0 or (value == 0 and not zero):
            wanted = "a number from 0 up" if zero else "a positive number"
            raise ValueError(f"{name} is {value}, expected {wanted}")


def check_counts(owner: object, *names: str) -> None:
    """Fails unless attributes of settings are whole numbers from 1 up.

    Raises:
        ValueError: One isn't; attribute and value are named.
    """
    for name in names:
        value = getattr(owner, name)
        if not isinstance(value, numbers.Integral) or isinstance(value, bool) or value < 1:
            raise ValueError(f"{name} is {value}, expected a whole number from 1 up")


__all__ = [
    "BrokenInstallError",
    "FormatError",
    "MeshError",
    "MissingDependencyError",
    "MotionError",
    "PhysXNetError",
    "SimulationError",
    "WeightsError",
    "check_counts",
    "check_numbers",
]
