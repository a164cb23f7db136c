"""The experiment's actions, as a table beside the motion files tells them."""

import csv
import dataclasses
import itertools
import pathlib
import re
from collections.abc import Callable
from typing import TypeVar

import numpy as np

from ..errors import MotionError
from ..motion import Motion, load_motion, sample

FPS = 30.0
_Row = TypeVar("_Row")
# Frames of what is left of a clip: two seconds at least, about as much as two actions at most.
_SHORTEST, _LONGEST = 60, 400
_HOW = (
    "Name the folder that holds it and the motion files (--mocap); docs/protocol.md tells its"
    " columns"
)


@dataclasses.dataclass(frozen=True)
class Action:
    """One row of the protocol.

    Attributes:
        split: ``train``, ``test`` or ``extra``.
        name: What the person does.
        file: Motion file, relative to the table.
        start: Where the action begins in the file [s].
        frames: Number of frames at 30 per second.
        fps: True frame rate of the file [1/s], None to believe its header.
    """

    split: str
    name: str
    file: str
    start: float
    frames: int
    fps: float | None

    @property
    def slug(self) -> str:
        """The name as a folder."""
        return re.sub(r"[^a-z0-9]+", "_", self.name.lower()).strip("_")


def _rows(path: pathlib.Path, read: Callable[[dict[str, str]], _Row]) -> list[_Row]:
    out = []
    with path.open(newline="", encoding="utf-8", errors="replace") as file:
        lines = csv.DictReader(file)
        for row in lines:
            try:
                out.append(read(row))
            except (KeyError, TypeError, ValueError) as error:
                raise MotionError.at(
                    path,
                    lines.line_num,
                    f"not a row of the protocol ({type(error).__name__}: {error})",
                    _HOW,
                ) from None
    return out


def read_protocol(folder: str | pathlib.Path) -> list[Action]:
    """The actions listed in ``ACTIONS.csv``, with true rates from ``CLIPS.csv``.

    Args:
        folder: Where both tables and the motion files lie.

    Raises:
        MotionError: No table there, or one without its columns and numbers.
    """
    folder = pathlib.Path(folder)
    table = folder / "ACTIONS.csv"
    if not table.is_file():
        raise MotionError.at(table, None, "no such file", _HOW)
    rates: dict[str, float] = {}
    clips = folder / "CLIPS.csv"
    if clips.is_file():
        rates = dict(_rows(clips, lambda row: (row["file"], float(row["fps"]))))
    actions = _rows(
        table,
        lambda row: Action(
            row["split"],
            row["action"],
            row["file"],
            float(row["start_s"]),
            int(row["frames_at_30fps"]),
            rates.get(row["file"]),
        ),
    )
    seen: dict[str, str] = {}
    for action in actions:
        if not action.slug or action.slug in seen:
            other = f"'{seen[action.slug]}' beside it" if action.slug else "letters a to z"
            raise MotionError.at(
                table,
                None,
                f"the action '{action.name}' has no folder of its own, for {other}",
                "Give each another name, of letters and digits",
            )
        seen[action.slug] = action.name
    return actions


def left_out(folder: str | pathlib.Path, actions: list[Action]) -> list[Action]:
    """The longest stretch of each action's clip that no action of the protocol uses.

    Clips that a test action is cut from are left alone, and so is what is shorter than
    two seconds; no stretch is longer than 400 frames.

    Args:
        folder: Where the motion files and ``ACTIONS.csv`` lie.
        actions: Whose clips are asked for.

    Returns:
        Actions of the same names and splits, with other frames; of several cut from one
        clip the first.
    """
    folder = pathlib.Path(folder)
    everything = read_protocol(folder)
    out, looked = [], set()
    for action in actions:
        # Of two actions cut from one clip the second would be given the same stretch again.
        if action.file in looked:
            continue
        looked.add(action.file)
        same = [a for a in everything if a.file == action.file]
        if any(a.split == "test" for a in same):
            continue
        clip = load_motion(folder / action.file, source_fps=action.fps)
        spans = sorted((a.start, a.start + a.frames / FPS) for a in same)
        # The first frame of many clips is a calibration pose.
        begins = [3.0 / FPS, *itertools.accumulate((end for _, end in spans), max)]
        ends = [*(begin for begin, _ in spans), (clip.num_frames - 1) / clip.fps]
        begin, end = max(zip(begins, ends), key=lambda gap: gap[1] - gap[0])
        frames = min(int((end - begin) * FPS), _LONGEST)
        if frames >= _SHORTEST:
            out.append(dataclasses.replace(action, start=begin, frames=frames))
    return out


def load_action(folder: str | pathlib.Path, action: Action) -> Motion:
    """The frames of an action, at 30 a second, by spherical interpolation.

    Raises:
        MotionError: Its file can't be read, or isn't as long.
    """
    clip = load_motion(pathlib.Path(folder) / action.file, source_fps=action.fps)
    end = action.start + (action.frames - 1) / FPS
    last = (clip.num_frames - 1) / clip.fps
    if not (action.start >= 0.0 and end <= last + 1e-3):
        raise MotionError(
            f"{action.file}: {action.name} goes from {action.start:g} to {end:.2f} s, the clip to"
            f" {last:.2f} s. Correct the table of actions."
        )
    times = action.start + np.arange(action.frames) / FPS
    motion = sample(clip, times, FPS)
    return Motion(motion.rotations, motion.root, FPS, action.name)
