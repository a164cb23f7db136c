"""Watching a run: logs, pictures, early stopping, the balance of the two players."""

import math
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from ..files import read_lines

METRICS = "metrics.jsonl"
# A discriminator that is right this often teaches the generator nothing any more.
_BEATEN = 0.97
# One this near to guessing has lost itself, or the generator is perfect.
_GUESSING = 0.52
# Its loss where it knows nothing and says so is 2 log 2: above this it diverges.
_THROWN = 1.6
# The generator's, -log D, is 1.7 where a discriminator knows all and is as unsure as its noisy
# labels: above this (D below 0.05) it is surer than they are, and its gradient is gone.
_HOPELESS = 3.0
# Weight of the newest measurement in the running means.
_NEWEST = 0.05
_WATCHED = ("discriminator_accuracy", "discriminator", "adversarial")


def read_metrics(folder: str | pathlib.Path) -> list[dict[str, Any]]:
    """All lines of a run's ``metrics.jsonl``; a line cut by a kill is dropped."""
    return read_lines(pathlib.Path(folder) / METRICS)


class Validation:
    """The best measurement so far, and whether it is time to stop.

    Args:
        lines: Of the log; what a run that goes on has measured before.
        step: Its step: later lines are of steps that will be done again.
        patience: Measurements without a better one that end the run.
    """

    def __init__(self, lines: Sequence[Mapping[str, Any]], step: int, patience: int) -> None:
        self.best, self._since, self._patience = math.inf, 0, patience
        # Steps that were done again after a kill are there twice.
        told = {x["step"]: x["validation_mm"] for x in lines if "validation_mm" in x}
        for at in sorted(told):
            if at <= step:
                self.update(told[at])

    def update(self, value: float) -> bool:
        """Takes a measurement; whether it is the best so far."""
        better = value < self.best
        # Not min(): one that isn't a number would be the best for ever.
        self.best = value if better else self.best
        self._since = 0 if better else self._since + 1
        return better

    @property
    def exhausted(self) -> bool:
        """No better measurement for too long."""
        return self._since >= self._patience


class Players:
    """Whether generator and discriminator still learn from each other.

    Args:
        noted: What an interrupted run has written, line by line.
        done: Up to which step it is kept.
    """

    def __init__(self, noted: Sequence[Mapping[str, float]] = (), done: int = 0) -> None:
        self._means: dict[str, float] = {}
        for line in noted:
            if line["step"] <= done:
                self._means |= {k: line[f"{k}_mean"] for k in _WATCHED if f"{k}_mean" in line}

    def update(self, metrics: Mapping[str, float]) -> dict[str, float]:
        """Running means of the discriminator's accuracy and of both losses, and an alarm.

        ``gan_alarm`` is 1 where the discriminator is nearly always right (its gradient
        is gone) or as good as guessing (it has collapsed), where its loss is worse than
        guessing's, where the generator's says that nothing it makes ever passes, or where
        one of them isn't a number; else 0.
        """
        if "discriminator_accuracy" not in metrics:
            return {}
        for k in _WATCHED:
            if k in metrics:
                old = self._means.get(k, metrics[k])
                self._means[k] = (1 - _NEWEST) * old + _NEWEST * metrics[k]
        accuracy = self._means["discriminator_accuracy"]
        fine = (
            _GUESSING <= accuracy <= _BEATEN
            and self._means.get("discriminator", 0.0) <= _THROWN
            and self._means.get("adversarial", 0.0) <= _HOPELESS
        )
        return {**{f"{k}_mean": v for k, v in self._means.items()}, "gan_alarm": float(not fine)}


class Board:
    """TensorBoard events and sample pictures, where tensorboardX is installed.

    Args:
        folder: The run's folder; events go to ``events`` within.
    """

    def __init__(self, folder: pathlib.Path) -> None:
        self._writer: Any = None
        try:
            from tensorboardX import SummaryWriter
        except ImportError:
            return
        self._writer = SummaryWriter(str(folder / "events"), write_to_disk=True)

    def write(self, values: Mapping[str, float], step: int) -> None:
        """Scalars of a step."""
        if self._writer is not None:
            for name, value in values.items():
                if name not in ("step", "seconds"):
                    self._writer.add_scalar(name, value, step)

    def show(self, maps: Mapping[str, tuple[np.ndarray, np.ndarray]], step: int) -> None:
        """Predicted maps beside wanted ones."""
        if self._writer is not None:
            for name, pair in maps.items():
                self._writer.add_image(f"maps/{name}", map_picture(*pair), step, dataformats="HWC")

    def close(self) -> None:
        """Writes what is left."""
        if self._writer is not None:
            self._writer.close()


def map_picture(
    predicted: Float[np.ndarray, "height width 3"], wanted: Float[np.ndarray, "height width 3"]
) -> np.ndarray:
    """Two offset maps and their difference side by side, as 8-bit RGB; grey is zero."""
    scale = max(float(np.quantile(np.abs(wanted), 0.99)), 1e-6)
    rows = np.concatenate([predicted, wanted, predicted - wanted], axis=1)
    return np.clip(127.5 * (1.0 + rows / scale), 0, 255).astype(np.uint8)
