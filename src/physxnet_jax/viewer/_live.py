"""Clothes that are computed in the moment they are looked at."""

import collections
import functools
import statistics
import time
from collections.abc import Callable

import jax
import numpy as np
from jaxtyping import Array, Float

from ..dressing import clothe_frame, make_dresser, start_clothing
from ..motion import Motion

# Frames over whose times a median is taken.
_RECENT = 30


class Live:
    """A clip's clothes by the streaming form: one frame in, one frame out.

    Any frame may be asked for; those that follow one another cost one step each. After a
    jump the frames that the network sees of the past are gone through first, so that
    what is shown is what the whole clip at once gives.

    Args:
        motion: The clip.
        wear: Templates and garment files.
        weights: Which network.
        shape: Shape parameters of the body; the default shape if None.
        push_out: Push vertices that end inside the body onto it.

    Raises:
        PhysXNetError: Anything that can't be read or bound; the text says why.
    """

    def __init__(
        self,
        motion: Motion,
        wear: tuple[str, ...],
        *,
        weights: str,
        shape: Float[Array, " shapes"] | None = None,
        push_out: bool = True,
    ) -> None:
        self._motion = motion
        self._dresser = make_dresser(wear, weights=weights, shape=shape, push_out=push_out)
        self._step = _step(motion.fps)
        self._start = jax.jit(start_clothing)
        self._times: collections.deque[float] = collections.deque(maxlen=_RECENT)
        self._next = -1
        # What is compiled isn't what a frame takes.
        self.frame(0)
        self._times.clear()

    @property
    def milliseconds(self) -> float:
        """Median time of the latest frames, from pose to vertices [ms]; NaN before any."""
        return statistics.median(self._times) if self._times else float("nan")

    def frame(self, index: int) -> dict[str, Float[np.ndarray, "vertices 3"]]:
        """Vertices of every garment in a frame of the clip [m]."""
        if index != self._next:
            window = self._dresser.predictor.config.inputs.window
            first = max(index + 1 - window, 0)
            rows = np.minimum(np.arange(first, first + window), self._motion.num_frames - 1)
            self._stream = self._start(self._dresser, *self._pose(rows))
            for earlier in range(first, index):
                self._stream, _ = self._step(self._dresser, self._stream, *self._pose(earlier))
        began = time.perf_counter()
        self._stream, cloth = self._step(self._dresser, self._stream, *self._pose(index))
        found = {name: np.asarray(x) for name, x in cloth.vertices.items()}
        self._times.append(1e3 * (time.perf_counter() - began))
        self._next = index + 1
        return found

    def _pose(self, index: int | np.ndarray) -> tuple[Array, Array]:
        return self._motion.rotations[index], self._motion.root[index]


@functools.lru_cache(4)
def _step(fps: float) -> Callable:
    """Compiled once for all clips of a rate."""
    return jax.jit(functools.partial(clothe_frame, fps=fps), donate_argnums=1)
