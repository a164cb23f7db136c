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
from ._outfit import Outfit, read_outfit
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
        name: Name of the sequence, see `Sequence`.
        action: Name of the action.
        split: ``train``, ``test`` or ``extra``.
        frames: Number of frames.
        fps: Frames per second.
        content: A short hash of its cloth.
        source: Its folder or URL, or the action itself.
        outfit: What is worn; None for the templates.
        mirrored: Whether its mirror image is meant.
    """

    name: str
    action: str
    split: str
    frames: int
    fps: float
    content: str
    source: Where | Sequence
    outfit: Outfit | None = None
    mirrored: bool = False

    def read(self) -> Sequence:
        """The action with its cloth, not mirrored."""
        return self.source if isinstance(self.source, Sequence) else read_sequence(self.source)


def read_entry(source: Where | Sequence | Entry) -> Entry:
    """The entry of a stored action, or of one in memory."""
    if isinstance(source, Entry):
        return source
    if isinstance(source, Sequence):
        s, content = source, content_hash(source.meta, source.offsets)
    else:
        s = read_description(source)
        content = content_hash(s.meta, None)
    m, action = s.motion, s.name if s.outfit is None else s.motion.name
    return Entry(s.name, action, s.split, m.num_frames, m.fps, content, source, s.outfit)


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
            str(line["action"]),
            str(line["split"]),
            int(line["frames"]),
            float(line["fps"]),
            str(line["content"]),
            join(root, str(line["folder"])),
            read_outfit(line["outfit"]),
        )
        for line in lines
        if split is None or line["split"] == split
    ]


def index_dataset(root: Where) -> None:
    """Writes the index of a dataset."""
    lines = []
    for folder in list_sequences(root):
        e = read_entry(folder)
        line = {"folder": last_name(folder), "name": e.name, "action": e.action, "split": e.split}
        outfit = None if e.outfit is None else dataclasses.asdict(e.outfit)
        line |= {"frames": e.frames, "fps": e.fps, "content": e.content, "outfit": outfit}
        lines.append(line)
    write_index(root, lines)


@dataclasses.dataclass(frozen=True)
class _Group:
    """Actions that are in memory together, and the frames of each step that uses them.

    Attributes:
        actions: Numbers of the actions, in whose order their frames are counted.
        starts: Number of each action's first frame, and of all frames.
        edges: First frame of each row's part, and the end of it, shape [rows, 2].
        order: Frames, shape [steps, rows].
    """

    actions: tuple[int, ...]
    starts: Int[np.ndarray, " bounds"]
    edges: Int[np.ndarray, "rows 2"]
    order: Int[np.ndarray, "steps rows"]

    def part(self, rows: slice) -> tuple[tuple[int, ...], int]:
        """The actions that some rows of all batches come from, and the first of their frames."""
        begin, end = self.edges[rows][0, 0], self.edges[rows][-1, 1]
        first = int(np.searchsorted(self.starts, begin, side="right")) - 1
        last = int(np.searchsorted(self.starts, end, side="left"))
        return self.actions[first:last], int(self.starts[first])


class FrameStream:
    """The training frames of actions, of which a limited number is in memory.

    If all fit, they are one group. Otherwise the actions of each epoch are put into groups at
    random: while one is learned from, the next is read. A group's frames are divided into as many
    parts as a batch has rows; each row goes through its own part in random order. So a process that
    needs some of the rows reads some of the actions, and the order depends on seed and step alone:
    a run can resume anywhere, on any number of processes.

    What is left over of each group, less than a batch, differs from epoch to epoch.

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
        self._kept: tuple[tuple[int, ...], Frames] | None = None

    def __len__(self) -> int:
        return self._count

    @property
    def steps_per_epoch(self) -> int:
        """Steps of an epoch."""
        return max(self._count // self._batch, 1)

    def first(self) -> Frames:
        """The first group of frames, for what needs a sample."""
        return self._read(self._epoch(0)[0].actions)

    def batches(self, start: int, rows: slice) -> "Batches":
        """Batches from a step on; of each the rows that this process needs."""
        return Batches(self._produce(start, rows))

    def _epoch(self, epoch: int) -> list[_Group]:
        rng = np.random.default_rng([self._seed, epoch])
        if self._count <= self._capacity:
            return [self._group(range(len(self._entries)), self.steps_per_epoch, rng)]
        chosen: list[list[int]] = [[]]
        size = 0
        for k in rng.permutation(len(self._entries)):
            frames = self._entries[k].frames
            if chosen[-1] and size + frames > self._capacity // 2:
                chosen.append([])
                size = 0
            chosen[-1].append(int(k))
            size += frames
        steps = [sum(self._entries[k].frames for k in c) // self._batch for c in chosen]
        # All epochs have the same number of steps.
        steps[-1] += self.steps_per_epoch - sum(steps)
        return [self._group(c, n, rng) for c, n in zip(chosen, steps, strict=True) if n]

    def _group(self, actions: Items[int], steps: int, rng: np.random.Generator) -> _Group:
        starts = np.cumsum([0, *(self._entries[k].frames for k in actions)])
        rows = np.arange(self._batch)
        begin = rows * starts[-1] // self._batch
        end = np.maximum((rows + 1) * starts[-1] // self._batch, begin + 1)
        order = [
            np.resize(a + rng.permutation(b - a), steps) for a, b in zip(begin, end, strict=True)
        ]
        return _Group(tuple(actions), starts, np.stack([begin, end], 1), np.stack(order, 1))

    def _read(self, actions: tuple[int, ...]) -> Frames:
        if self._kept is not None and self._kept[0] == actions:
            return self._kept[1]
        # First, since what was kept isn't needed any more.
        self._kept = None
        frames = self._load(self._sequences(actions))
        if self._count <= self._capacity:
            self._kept = actions, frames
        return frames

    def _sequences(self, actions: tuple[int, ...]) -> Iterator[Sequence]:
        # One at a time, since each is as large as its part of the frames.
        for k in actions:
            entry = self._entries[k]
            s = entry.read()
            yield self._mirror(s) if entry.mirrored else s

    def _produce(self, start: int, rows: slice) -> Iterator[dict[str, np.ndarray]]:
        epoch, at = divmod(start, self.steps_per_epoch)
        loaded: dict[tuple[int, ...], concurrent.futures.Future[Frames]] = {}
        with concurrent.futures.ThreadPoolExecutor(1) as reader:
            groups = self._epoch(epoch)
            while True:
                following = self._epoch(epoch + 1)
                for group, after in zip(groups, [*groups[1:], following[0]], strict=True):
                    if at >= len(group.order):
                        at -= len(group.order)
                        continue
                    actions, first = group.part(rows)
                    needed = (actions, after.part(rows)[0])
                    for key in set(loaded) - set(needed):
                        del loaded[key]
                    for key in needed:
                        if key not in loaded:
                            loaded[key] = reader.submit(self._read, key)
                    frames = loaded[actions].result()
                    for index in group.order[at:, rows]:
                        yield take(frames, index - first)
                    at = 0
                    del frames
                epoch, groups = epoch + 1, following


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
