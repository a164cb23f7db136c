"""Garments that are computed frame by frame while they are shown."""

import collections
import functools
import statistics
import time
from collections.abc import Callable

import jax
import numpy as np
from jaxtyping import Array, Float

from ..dressing import Inference, Simulation, clothe_step, init_stream, make_dresser
from ..motion import Motion

# Number of recent frames whose median time is reported.
_RECENT = 30


class Live:
    """Computes a clip's garments by the streaming form: one frame in, one frame out.

    Any frame may be requested; consecutive frames cost one step each. After a jump the
    network's window of past frames is processed first, so that the result equals that of
    the whole clip at once; simulated cloth starts there.

    Args:
        motion: The clip.
        wear: Templates and garment files.
        method: ``network`` or ``guided``.
        inference: Weights and post-processing.
        simulation: Effects of ``guided``.
        shape: Shape parameters of the body; the default shape if None.

    Raises:
        PhysXNetError: An input can't be read or bound; the text gives the reason.
    """

    def __init__(
        self,
        motion: Motion,
        wear: tuple[str, ...],
        *,
        method: str = "network",
        inference: Inference,
        simulation: Simulation | None = None,
        shape: Float[Array, " shapes"] | None = None,
    ) -> None:
        self._motion = motion
        self._dresser = make_dresser(
            wear,
            method=method,  # pyright: ignore[reportArgumentType]
            inference=inference,
            simulation=simulation,
            shape=shape,
        )
        self._step = _step(motion.fps)
        self._start = jax.jit(functools.partial(init_stream, fps=motion.fps))
        self._times: collections.deque[float] = collections.deque(maxlen=_RECENT)
        self._next = -1
        # The first frame compiles: its time is dropped.
        self.frame(0)
        self._times.clear()

    @property
    def milliseconds(self) -> float:
        """Median time of the latest frames, from pose to vertices [ms]; NaN before any."""
        return statistics.median(self._times) if self._times else float("nan")

    def frame(self, index: int) -> dict[str, Float[np.ndarray, "vertices 3"]]:
        """Vertices of every garment in a frame of the clip [m]."""
        if index != self._next:
            window = self._dresser.history_length(self._motion.fps) + 1
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
    """The jitted step, compiled once for all clips of a frame rate."""
    return jax.jit(functools.partial(clothe_step, fps=fps), donate_argnums=1)
