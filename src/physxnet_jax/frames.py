"""Frames of clips that may be larger than memory."""

import contextlib
import contextvars
import errno
import math
import mmap
import os
import pathlib
import shutil
import tempfile
import weakref
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
from jaxtyping import Float

from .errors import DiskFullError

IN_MEMORY = 64_000_000
"""Positions of a mesh that take more are kept in a file [bytes]."""
# What is read or written at once [bytes].
_CHUNK = 16_000_000
_folder: contextvars.ContextVar[pathlib.Path | None] = contextvars.ContextVar(
    "folder", default=None
)


@contextlib.contextmanager
def scratch_folder(folder: str | pathlib.Path) -> Iterator[None]:
    """Within it, frames that don't fit in memory are kept on the disk of this folder.

    Otherwise on that of temporary files, which may be memory itself.
    """
    token = _folder.set(pathlib.Path(folder))
    try:
        yield
    finally:
        _folder.reset(token)


class FrameStore:
    """Frames of a mesh, appended in blocks.

    What is larger than `IN_MEMORY` is kept in a file without a name, which the system removes with
    the last array that uses it, however the process ends.

    Args:
        frames: Number of frames that will be appended.

    Example:
        >>> store = FrameStore(3)
        >>> store.append(np.zeros((2, 5, 3), np.float32))
        >>> store.append(np.ones((1, 5, 3), np.float32))
        >>> store.array().shape
        (3, 5, 3)
    """

    def __init__(self, frames: int) -> None:
        self.frames = frames
        self.count = 0
        self._array: np.ndarray | None = None
        self._file: Any = None
        self._frame: np.ndarray | None = None

    def append(self, block: Float[np.ndarray, "some vertices 3"]) -> None:
        """Appends frames.

        Raises:
            DiskFullError: All frames together don't fit on the disk.
            ValueError: There are more frames than announced.
        """
        block = np.asarray(block)
        if self._frame is None:
            self._frame = np.empty((0, *block.shape[1:]), block.dtype)
            size = self.frames * math.prod(block.shape[1:]) * block.itemsize
            if size <= IN_MEMORY:
                self._array = np.empty((self.frames, *block.shape[1:]), block.dtype)
            else:
                self._file = _scratch_file(size)
                weakref.finalize(self, self._file.close)
        if self.count + len(block) > self.frames:
            raise ValueError(f"{self.count + len(block)} frames, announced were {self.frames}")
        if self._file is not None:
            # Not by way of a mapping: a full disk would end the process.
            with _on_a_full_disk():
                self._file.write(np.ascontiguousarray(block).data)
        elif self._array is not None:
            self._array[self.count : self.count + len(block)] = block
        self.count += len(block)

    def array(self) -> Float[np.ndarray, "frames vertices 3"]:
        """The frames, once all are appended; read from the file as they are used if it has them.

        Raises:
            ValueError: Frames are missing.
        """
        if self._frame is None or self.count < self.frames:
            raise ValueError(f"{self.count} frames, announced were {self.frames}")
        if self._array is None:
            with _on_a_full_disk():
                self._file.flush()
            shape = (self.count, *self._frame.shape[1:])
            self._array = np.asarray(np.memmap(self._file, self._frame.dtype, "r", shape=shape))
            # The mapping keeps the file.
            self._file.close()
        return self._array


def _scratch_file(size: int) -> Any:
    folder = _folder.get() or pathlib.Path(tempfile.gettempdir())
    folder.mkdir(parents=True, exist_ok=True)
    free = shutil.disk_usage(folder).free
    if free < size:
        raise DiskFullError(
            f"{folder}: {size / 1e6:.0f} MB are needed for frames that don't fit in memory, but"
            f" {free / 1e6:.0f} MB are free. Free some space, choose another disk or fewer frames."
        )
    file = tempfile.TemporaryFile(dir=folder)
    if hasattr(os, "posix_fallocate"):
        try:
            # Taken at once: others write to the disk as well.
            os.posix_fallocate(file.fileno(), 0, size)
        except OSError as error:
            if error.errno == errno.ENOSPC:
                file.close()
                raise DiskFullError(f"{folder}: {size / 1e6:.0f} MB don't fit on it.") from error
    return file


@contextlib.contextmanager
def _on_a_full_disk() -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise DiskFullError(
            f"frames that don't fit in memory can't be kept ({error.strerror}). Free some space,"
            " choose another disk or fewer frames."
        ) from error


def in_chunks(
    positions: Float[np.ndarray, "frames vertices 3"],
) -> Iterator[Float[np.ndarray, "some vertices 3"]]:
    """Yields successive frames; what was read from a file leaves memory again.

    Example:
        >>> [len(x) for x in in_chunks(np.zeros((5, 2, 3)))]
        [5]
    """
    step = max(1, _CHUNK // max(1, positions[:1].nbytes))
    for start in range(0, len(positions), step):
        yield positions[start : start + step]
        _forget(positions)


def _forget(array: np.ndarray) -> None:
    """Gives up the memory of an array's file; it is read again when it is used."""
    if array.flags.writeable:
        # It may have been changed in memory alone.
        return
    base: Any = array
    while isinstance(base, np.ndarray):
        base = base.base
    if isinstance(base, mmap.mmap) and hasattr(mmap, "MADV_DONTNEED"):
        base.madvise(mmap.MADV_DONTNEED)


def moved_frames(
    positions: Float[np.ndarray, "frames vertices 3"], by: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "frames vertices 3"]:
    """Positions displaced [m]; the same array if that is zero."""
    if not by.any():
        return positions
    return all_frames(len(positions), (x + by for x in in_chunks(positions)))


def all_frames(
    frames: int, blocks: Iterable[Float[np.ndarray, "some vertices 3"]]
) -> Float[np.ndarray, "frames vertices 3"]:
    """Blocks in one array, by way of a `FrameStore`."""
    store = FrameStore(frames)
    for block in blocks:
        store.append(block)
    return store.array()
