"""Time since a command was started, so that its stages account for all of it."""

import time

_started = [time.perf_counter()]


def start() -> None:
    """Starts the clock."""
    _started[0] = time.perf_counter()


def lap() -> float:
    """Time since the last call, or since the start [ms]."""
    now = time.perf_counter()
    passed, _started[0] = now - _started[0], now
    return 1e3 * passed
