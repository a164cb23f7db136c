"""Batches of training frames, read from the store beside the steps that use them."""

import concurrent.futures
import dataclasses
import queue
import threading
import time
from collections.abc import Callable, Iterator, Sequence as Items
from typing import Any

import numpy as np
from jaxtyping import Int

from ..errors import FormatError
from ._files import join, last_name
from ._frames import Frames, content_hash, take
from ._store import (
    Sequence,
    Where,
    list_sequences,
    read_description,
    read_index,
    read_sequence,
    write_index,
)

_Load = Callable[[Iterator[Sequence]], Frames]
# Batches that are ready before they are needed.
_AHEAD = 4


@dataclasses.dataclass(frozen=True)
class Entry:
    """An action of which the cloth isn't read yet.

    Attributes:
        name: Name of the action.
        split: ``train``, ``test`` or ``extra``.
        frames: Number of frames.
        fps: Frames per second.
        content: A short hash of its cloth.
        source: Its folder or URL, or the action itself.
        mirrored: Whether its mirror image is meant.
    """

    name: str
    split: str
    frames: int
    fps: float
    content: str
    source: Where | Sequence
    mirrored: bool = False

    def read(self) -> Sequence:
        """The action with its cloth, not mirrored."""
        return self.source if isinstance(self.source, Sequence) else read_sequence(self.source)


def read_entry(source: Where | Sequence | Entry) -> Entry:
    """The entry of a stored action, or of one in memory."""
    if isinstance(source, Entry):
        return source
    if isinstance(source, Sequence):
        motion, content = source.motion, content_hash(source.meta, source.offsets)
        return Entry(source.name, source.split, motion.num_frames, motion.fps, content, source)
    split, motion, meta = read_description(source)
    content = content_hash(meta, None)
    return Entry(motion.name, split, motion.num_frames, motion.fps, content, source)


def list_entries(root: Where, split: str | None = None) -> list[Entry]:
    """The entries of a dataset's actions, optionally of one split; their cloth isn't read.

    They come from the index that a build writes; without one each action is looked at.
    """
    lines = read_index(root)
    if lines is None:
        return [read_entry(f) for f in list_sequences(root, split)]
    return [
        Entry(
            str(line["name"]),
            str(line["split"]),
            int(line["frames"]),
            float(line["fps"]),
            str(line["content"]),
            join(root, str(line["folder"])),
        )
        for line in lines
        if split is None or line["split"] == split
    ]


def index_dataset(root: Where) -> None:
    """Writes the index of a dataset."""
    lines = []
    for folder in list_sequences(root):
        e = read_entry(folder)
        line = {"folder": last_name(folder), "name": e.name, "split": e.split}
        lines.append(line | {"frames": e.frames, "fps": e.fps, "content": e.content})
    write_index(root, lines)


class FrameStream:
    """The training frames of actions, of which a limited number is in memory.

    If all fit, an epoch is a permutation of them. Otherwise it is a permutation of the actions in
    groups, with the frames of each group permuted: while one is learned from, the next is read.
    The order depends on seed and step alone, so that a run can resume anywhere.

    Args:
        entries: Actions.
        load: Turns actions, in which mirror images are mirrored, into frames.
        mirror: Makes the mirror image of an action.
        batch: Frames a step.
        seed: Seed of the order.
        capacity: Frames in memory at most, as long as no action has more than half as many.

    Raises:
        FormatError: No actions, or actions of different frame rates.
    """

    def __init__(
        self,
        entries: Items[Entry],
        load: _Load,
        mirror: Callable[[Sequence], Sequence],
        *,
        batch: int,
        seed: int,
        capacity: int,
    ) -> None:
        if not entries:
            raise FormatError("no sequence to train on; build a dataset first.")
        rates = {e.fps for e in entries}
        if len(rates) != 1:
            raise FormatError(f"sequences of different frame rates: {sorted(rates)}.")
        self.fps = rates.pop()
        self.identity = ", ".join(f"{e.name} {e.frames} {e.content}" for e in entries)
        self._entries, self._load, self._mirror = list(entries), load, mirror
        self._batch, self._seed, self._capacity = batch, seed, capacity
        self._count = sum(e.frames for e in entries)
        self._whole: Frames | None = None

    def __len__(self) -> int:
        return self._count

    @property
    def steps_per_epoch(self) -> int:
        """Steps of an epoch."""
        return max(self._count // self._batch, 1)

    def first(self) -> Frames:
        """The first group of frames, for what needs a sample."""
        groups, _ = self._epoch(0)
        return self._read(groups[0])

    def batches(self, start: int, rows: slice) -> "Batches":
        """Batches from a step on; of each the rows that this process needs."""
        return Batches(self._produce(start, rows))

    def _epoch(self, epoch: int) -> tuple[list[list[int]], Int[np.ndarray, " frames"]]:
        """Actions of each group, and the order of frames, numbered from group to group."""
        rng = np.random.default_rng([self._seed, epoch])
        if self._count <= self._capacity:
            return [list(range(len(self._entries)))], rng.permutation(self._count)
        groups: list[list[int]] = [[]]
        size = 0
        for k in rng.permutation(len(self._entries)):
            frames = self._entries[k].frames
            if groups[-1] and size + frames > self._capacity // 2:
                groups.append([])
                size = 0
            groups[-1].append(int(k))
            size += frames
        order, begin = [], 0
        for group in groups:
            frames = self._frames_of(group)
            order.append(begin + rng.permutation(frames))
            begin += frames
        return groups, np.concatenate(order)

    def _frames_of(self, group: list[int]) -> int:
        return sum(self._entries[k].frames for k in group)

    def _read(self, group: list[int]) -> Frames:
        if self._whole is not None:
            return self._whole
        frames = self._load(self._sequences(group))
        if self._count <= self._capacity:
            self._whole = frames
        return frames

    def _sequences(self, group: list[int]) -> Iterator[Sequence]:
        # One at a time, since each is as large as its part of the frames.
        for k in group:
            entry = self._entries[k]
            s = entry.read()
            yield self._mirror(s) if entry.mirrored else s

    def _produce(self, start: int, rows: slice) -> Iterator[dict[str, np.ndarray]]:
        per_epoch = self.steps_per_epoch
        epoch, at = divmod(start, per_epoch)
        loaded: dict[tuple[int, ...], concurrent.futures.Future[Frames]] = {}
        with concurrent.futures.ThreadPoolExecutor(1) as reader:

            def need(wanted: list[list[int]]) -> None:
                """Starts to read groups, and forgets all others."""
                keys = [tuple(g) for g in wanted]
                for key in set(loaded) - set(keys):
                    del loaded[key]
                for key in keys:
                    if key not in loaded:
                        loaded[key] = reader.submit(self._read, list(key))

            while True:
                groups, order = self._epoch(epoch)
                ends = np.cumsum([self._frames_of(g) for g in groups])
                after = self._epoch(epoch + 1)[0][0]
                for step in range(at, per_epoch):
                    index = order[step * self._batch : (step + 1) * self._batch]
                    index = np.resize(index, self._batch)
                    used = np.searchsorted(ends, index, side="right")
                    last = int(used.max())
                    behind = groups[last + 1] if last + 1 < len(groups) else after
                    need([*groups[int(used.min()) : last + 1], behind])
                    yield self._gather(groups, ends, index[rows], loaded)
                epoch, at = epoch + 1, 0

    def _gather(
        self,
        groups: list[list[int]],
        ends: np.ndarray,
        index: np.ndarray,
        loaded: dict[tuple[int, ...], "concurrent.futures.Future[Frames]"],
    ) -> dict[str, np.ndarray]:
        used = np.searchsorted(ends, index, side="right")
        parts = []
        for g in np.unique(used):
            begin = ends[g] - self._frames_of(groups[g])
            frames = loaded[tuple(groups[g])].result()
            parts.append(take(frames, index[used == g] - begin))
        if len(parts) == 1:
            return parts[0]
        # Groups follow each other within a batch, so parts are in the order of the index.
        return {k: np.concatenate([p[k] for p in parts]) for k in parts[0]}


class Batches:
    """Batches of an iterator, which runs ahead in a thread of its own; close it at the end.

    Args:
        source: What yields the batches.
    """

    def __init__(self, source: Iterator[dict[str, np.ndarray]]) -> None:
        self._ready: queue.Queue[Any] = queue.Queue(_AHEAD)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, args=(source,), daemon=True)
        self.waited = 0.0
        """Seconds in which a batch was needed and not ready."""
        self._thread.start()

    def __iter__(self) -> "Batches":
        return self

    def __next__(self) -> dict[str, np.ndarray]:
        began = time.perf_counter()
        got = self._ready.get()
        self.waited += time.perf_counter() - began
        if isinstance(got, BaseException):
            raise got
        return got

    def close(self) -> None:
        """Ends the thread."""
        self._stop.set()
        while self._thread.is_alive():
            try:
                self._ready.get_nowait()
            except queue.Empty:
                self._thread.join(0.05)

    def _run(self, source: Iterator[dict[str, np.ndarray]]) -> None:
        try:
            for batch in source:
                if not self._put(batch):
                    return
        # It is raised where the batch would have been used.
        except BaseException as error:
            self._put(error)

    def _put(self, what: Any) -> bool:
        while not self._stop.is_set():
            try:
                self._ready.put(what, timeout=0.05)
            except queue.Full:
                continue
            return True
        return False
