"""Timing of stages."""

import contextlib
import dataclasses
import time
from collections.abc import Iterator


@dataclasses.dataclass(frozen=True)
class Stage:
    """Time of one stage.

    Attributes:
        name: Name of the stage.
        cold_ms: Time of the first run, compilation included [ms]; the total time of a
            stage that doesn't run by frames.
        warm_ms: Median time of later runs [ms per frame]; None if it ran once.
    """

    name: str
    cold_ms: float
    warm_ms: float | None = None


@contextlib.contextmanager
def timed(stages: list[Stage], name: str) -> Iterator[None]:
    """Appends the time of the enclosed stage."""
    start = time.perf_counter()
    yield
    stages.append(Stage(name, 1e3 * (time.perf_counter() - start)))
