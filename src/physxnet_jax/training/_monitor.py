"""Monitoring a run: logs, images, early stopping, balance of generator and discriminator."""

import math
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from ..files import read_lines

METRICS = "metrics.jsonl"
# Above this accuracy the discriminator gives the generator no useful gradient.
_MAX_ACCURACY = 0.97
# Below this accuracy, close to guessing, it has collapsed, or the generator is perfect.
_MIN_ACCURACY = 0.52
# The discriminator's loss is 2 log 2 where D is 0.5 everywhere; above this value it diverges.
_MAX_DISCRIMINATOR_LOSS = 1.6
# The generator's loss, -log D, is 1.7 for a perfect discriminator that is as uncertain as its noisy
# labels. Above this value (D below 0.05) it is overconfident, and its gradient vanishes.
_MAX_ADVERSARIAL_LOSS = 3.0
# Weight of the newest measurement in the running means.
_MEAN_WEIGHT = 0.05
_MONITORED = ("discriminator_accuracy", "discriminator", "adversarial")


def read_metrics(folder: str | pathlib.Path) -> list[dict[str, Any]]:
    """All lines of a run's ``metrics.jsonl``; incomplete lines are dropped."""
    return read_lines(pathlib.Path(folder) / METRICS)


class EarlyStopping:
    """Tracks the best validation error and when to stop.

    Args:
        lines: Lines of the log, with the previous validations of a resumed run.
        step: Step that the run resumes from; later steps will be repeated.
        patience: Stop after this many validations without improvement.
    """

    def __init__(self, lines: Sequence[Mapping[str, Any]], step: int, patience: int) -> None:
        self.best, self._since, self._patience = math.inf, 0, patience
        # Steps that were repeated after an interruption occur twice.
        measured = {x["step"]: x["validation_mm"] for x in lines if "validation_mm" in x}
        for at in sorted(measured):
            if at <= step:
                self.update(measured[at])

    def update(self, value: float) -> bool:
        """Adds a measurement; returns whether it is the best so far."""
        better = value < self.best
        # Not min(): a NaN would stay the best for ever.
        self.best = value if better else self.best
        self._since = 0 if better else self._since + 1
        return better

    @property
    def exhausted(self) -> bool:
        """Whether the last ``patience`` measurements brought no improvement."""
        return self._since >= self._patience


class GanMonitor:
    """Monitors whether generator and discriminator still learn from each other.

    Args:
        noted: Lines of the log of an interrupted run.
        done: Step that the run resumes from; later lines are ignored.
    """

    def __init__(self, noted: Sequence[Mapping[str, float]] = (), done: int = 0) -> None:
        self._means: dict[str, float] = {}
        for line in noted:
            if line["step"] <= done:
                self._means |= {k: line[f"{k}_mean"] for k in _MONITORED if f"{k}_mean" in line}

    def update(self, metrics: Mapping[str, float]) -> dict[str, float]:
        """Running means of the discriminator's accuracy and of both losses, and an alarm.

        ``gan_alarm`` is 1 if the discriminator is nearly always right (its gradient
        vanishes) or about as good as guessing (it has collapsed), if its loss is worse than
        that of guessing, if the generator's loss shows that none of its maps pass as real, or
        if one of them is NaN; else 0.
        """
        if "discriminator_accuracy" not in metrics:
            return {}
        for k in _MONITORED:
            if k in metrics:
                old = self._means.get(k, metrics[k])
                self._means[k] = (1 - _MEAN_WEIGHT) * old + _MEAN_WEIGHT * metrics[k]
        accuracy = self._means["discriminator_accuracy"]
        healthy = (
            _MIN_ACCURACY <= accuracy <= _MAX_ACCURACY
            and self._means.get("discriminator", 0.0) <= _MAX_DISCRIMINATOR_LOSS
            and self._means.get("adversarial", 0.0) <= _MAX_ADVERSARIAL_LOSS
        )
        return {**{f"{k}_mean": v for k, v in self._means.items()}, "gan_alarm": float(not healthy)}


class TensorBoardLogger:
    """Writes TensorBoard events and sample images, if tensorboardX is installed.

    Args:
        folder: The run's folder; events go to its subfolder ``events``.
    """

    def __init__(self, folder: pathlib.Path) -> None:
        self._writer: Any = None
        try:
            from tensorboardX import SummaryWriter
        except ImportError:
            return
        self._writer = SummaryWriter(str(folder / "events"), write_to_disk=True)

    def write(self, values: Mapping[str, float], step: int) -> None:
        """Writes the scalars of a step."""
        if self._writer is not None:
            for name, value in values.items():
                if name not in ("step", "seconds"):
                    self._writer.add_scalar(name, value, step)

    def show(self, maps: Mapping[str, tuple[np.ndarray, np.ndarray]], step: int) -> None:
        """Writes images of predicted maps beside target maps."""
        if self._writer is not None:
            for name, pair in maps.items():
                self._writer.add_image(f"maps/{name}", map_picture(*pair), step, dataformats="HWC")

    def close(self) -> None:
        """Writes pending events and closes the file."""
        if self._writer is not None:
            self._writer.close()


def map_picture(
    predicted: Float[np.ndarray, "height width 3"], target: Float[np.ndarray, "height width 3"]
) -> np.ndarray:
    """Two offset maps and their difference side by side, as 8-bit RGB; grey is zero."""
    scale = max(float(np.quantile(np.abs(target), 0.99)), 1e-6)
    rows = np.concatenate([predicted, target, predicted - target], axis=1)
    return np.clip(127.5 * (1.0 + rows / scale), 0, 255).astype(np.uint8)
