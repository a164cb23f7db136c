"""Where the time goes."""

import dataclasses
import time


@dataclasses.dataclass(frozen=True)
class Stage:
    """Time of one stage.

    Attributes:
        name: What was done.
        cold_ms: First time, compilation included [ms]; in all if not by frame.
        warm_ms: Median of the later times [ms a frame]; None if it ran once.
    """

    name: str
    cold_ms: float
    warm_ms: float | None = None


class Watch:
    """Notes how long each stage takes."""

    def __init__(self, stages: list[Stage]) -> None:
        self._stages = stages
        self._name = ""
        self._start = 0.0

    def __call__(self, name: str) -> "Watch":
        self._name = name
        return self

    def __enter__(self) -> None:
        self._start = time.perf_counter()

    def __exit__(self, *error: object) -> None:
        self._stages.append(Stage(self._name, 1e3 * (time.perf_counter() - self._start)))
