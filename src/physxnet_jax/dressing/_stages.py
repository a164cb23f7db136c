"""Timing of stages."""

import dataclasses
import time


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


class Watch:
    """Records how long each stage takes."""

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
