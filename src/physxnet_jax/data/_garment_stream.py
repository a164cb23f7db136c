"""Batches in which every template has samples of its own."""

import concurrent.futures
import dataclasses
from collections.abc import Iterator, Mapping

import numpy as np

from ._frames import Frames
from ._stream import Batches, FrameStream

# What describes the motion of a sample, whatever it wears.
_MOTION = ("rotations", "translations", "person")


def join_templates(parts: Mapping[str, dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """One batch from one of each template: motion gets an axis of templates after the first.

    Rows stay together, so that a part of the rows is a part of each template's.
    """
    every = list(parts.values())
    out = {k: np.stack([p[k] for p in every], axis=1) for k in _MOTION}
    for name, part in parts.items():
        out |= {k: v for k, v in part.items() if k.endswith(f"_{name}")}
    return out


@dataclasses.dataclass(frozen=True)
class TemplateStreams:
    """A stream of frames for each template: a network that sees garments decodes each sample once.

    Attributes:
        streams: For each template the frames of those who wear it, with equal batches.
    """

    streams: dict[str, FrameStream]

    @property
    def fps(self) -> float:
        """Frames per second."""
        return next(iter(self.streams.values())).fps

    @property
    def identity(self) -> str:
        """What the frames are."""
        return "; ".join(f"{t}: {s.identity}" for t, s in self.streams.items())

    @property
    def steps_per_epoch(self) -> int:
        """Steps in which each template's frames are seen once, or more often."""
        return max(s.steps_per_epoch for s in self.streams.values())

    def first(self) -> dict[str, Frames]:
        """Each template's first group of frames, read side by side."""
        with concurrent.futures.ThreadPoolExecutor(len(self.streams)) as pool:
            found = {t: pool.submit(s.first) for t, s in self.streams.items()}
            return {t: f.result() for t, f in found.items()}

    def batches(self, start: int, rows: slice) -> Batches:
        """Batches from a step on; of each the rows that this process needs."""
        return Batches(self._joined(start, rows))

    def _joined(self, start: int, rows: slice) -> Iterator[dict[str, np.ndarray]]:
        each = {t: s.batches(start, rows) for t, s in self.streams.items()}
        try:
            while True:
                yield join_templates({t: next(b) for t, b in each.items()})
        finally:
            for b in each.values():
                b.close()
