"""The experiment's actions, read from a table beside the motion files."""

import csv
import dataclasses
import itertools
import pathlib
import re
from collections.abc import Callable
from typing import TypeVar

import numpy as np

from ..errors import MotionError, PhysXNetError
from ..files import atomic_write
from ..motion import Motion, load_motion, sample

FPS = 30.0
_Row = TypeVar("_Row")
# Length of an unused stretch in frames: at least two seconds, at most about two actions.
_MIN_FRAMES, _MAX_FRAMES = 60, 400
_FIX = (
    "Pass the folder that holds it and the motion files (--mocap); docs/protocol.md lists its"
    " columns"
)


@dataclasses.dataclass(frozen=True)
class Action:
    """One row of the protocol.

    Attributes:
        split: ``train``, ``test`` or ``extra``.
        name: Name of the action.
        file: Motion file, relative to the table.
        start: Where the action begins in the file [s].
        frames: Number of frames at 30 per second.
        fps: True frame rate of the file [1/s]; None to use that of its header.
    """

    split: str
    name: str
    file: str
    start: float
    frames: int
    fps: float | None

    @property
    def slug(self) -> str:
        """The name as a folder name."""
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
                    _FIX,
                ) from None
    return out


def read_protocol(folder: str | pathlib.Path) -> list[Action]:
    """The actions listed in ``ACTIONS.csv``, with true rates from ``CLIPS.csv``.

    Args:
        folder: Folder with both tables and the motion files.

    Raises:
        MotionError: The table is missing or malformed, or two actions share a folder name.
    """
    folder = pathlib.Path(folder)
    table = folder / "ACTIONS.csv"
    if not table.is_file():
        raise MotionError.at(table, None, "no such file", _FIX)
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
            other = f"'{seen[action.slug]}' has the same" if action.slug else "no a to z or 0 to 9"
            raise MotionError.at(
                table,
                None,
                f"no unique folder name for the action '{action.name}': {other}",
                "Give every action a distinct name of letters and digits",
            )
        seen[action.slug] = action.name
    return actions


_COLUMNS = ("split", "action", "file", "start_s", "frames_at_30fps", "note")
_MOTIONS = (".bvh", ".amc", ".npz", ".pkl", ".glb", ".gltf", ".vrma")
# Of so many motions one is a test action.
_TEST_EVERY = 5


def write_protocol(
    folder: str | pathlib.Path, progress: Callable[[str, int, int], None] | None = None
) -> tuple[pathlib.Path, tuple[str, ...]]:
    """Writes ``ACTIONS.csv`` for a folder of motion files, to be edited.

    Every file becomes an action over its whole length; every fifth is a test action, of two to
    four the last.

    Args:
        folder: The folder; files in folders below it count too.
        progress: Called with a stage, the files done and the total.

    Returns:
        The table, and a line for each file that isn't read.

    Raises:
        MotionError: There is a table already, or no motion that can be read.
    """
    folder = pathlib.Path(folder)
    table = folder / "ACTIONS.csv"
    if table.exists():
        raise MotionError.at(table, None, "exists already", "Edit it, or move it away")
    files = sorted(p for p in folder.rglob("*") if p.suffix.lower() in _MOTIONS)
    rows, unread, taken = [], [], set()
    for k, path in enumerate(files):
        try:
            clip = load_motion(path)
        except (PhysXNetError, OSError) as error:
            unread.append(str(error))
            continue
        name = re.sub(r"[^A-Za-z0-9]+", " ", path.stem).strip() or f"motion {k}"
        while name.lower() in taken:
            name += " again"
        taken.add(name.lower())
        split = "test" if len(rows) % _TEST_EVERY == _TEST_EVERY - 1 else "train"
        frames = max(1, int(clip.num_frames * 30.0 / clip.fps))
        rows.append((split, name, path.relative_to(folder).as_posix(), 0, frames, ""))
        if progress is not None:
            progress("motions", k + 1, len(files))
    if not rows:
        raise MotionError.at(folder, None, "no motion that can be read", "Put motion files there")
    if 1 < len(rows) < _TEST_EVERY:
        rows[-1] = ("test", *rows[-1][1:])
    with atomic_write(table) as part, part.open("w", newline="", encoding="utf-8") as out:
        lines = csv.writer(out)
        lines.writerow(_COLUMNS)
        lines.writerows(rows)
    return table, tuple(unread)


def left_out(folder: str | pathlib.Path, actions: list[Action]) -> list[Action]:
    """The longest stretch of each action's clip that no action of the protocol uses.

    Clips that contain a test action are skipped, and so are stretches shorter than two
    seconds. Stretches are cut to 400 frames.

    Args:
        folder: Folder with the motion files and ``ACTIONS.csv``.
        actions: Actions whose clips are searched.

    Returns:
        Actions of the same names and splits with other frames. Of several actions cut from
        one clip, only the first is returned.
    """
    folder = pathlib.Path(folder)
    all_actions = read_protocol(folder)
    out, searched = [], set()
    for action in actions:
        # A second action cut from the same clip would get the same stretch.
        if action.file in searched:
            continue
        searched.add(action.file)
        same_clip = [a for a in all_actions if a.file == action.file]
        if any(a.split == "test" for a in same_clip):
            continue
        clip = load_motion(folder / action.file, source_fps=action.fps)
        spans = sorted((a.start, a.start + a.frames / FPS) for a in same_clip)
        # The first frame of many clips is a calibration pose.
        begins = [3.0 / FPS, *itertools.accumulate((end for _, end in spans), max)]
        ends = [*(begin for begin, _ in spans), (clip.num_frames - 1) / clip.fps]
        begin, end = max(zip(begins, ends), key=lambda gap: gap[1] - gap[0])
        frames = min(int((end - begin) * FPS), _MAX_FRAMES)
        if frames >= _MIN_FRAMES:
            out.append(dataclasses.replace(action, start=begin, frames=frames))
    return out


def load_action(folder: str | pathlib.Path, action: Action) -> Motion:
    """The frames of an action, resampled to 30 per second by spherical interpolation.

    Raises:
        MotionError: Its file can't be read or doesn't cover the action.
    """
    clip = load_motion(pathlib.Path(folder) / action.file, source_fps=action.fps)
    end = action.start + (action.frames - 1) / FPS
    last = (clip.num_frames - 1) / clip.fps
    if not (action.start >= 0.0 and end <= last + 1e-3):
        raise MotionError(
            f"{action.file}: {action.name} goes from {action.start:g} to {end:.2f} s, but the"
            f" clip ends at {last:.2f} s. Correct the table of actions."
        )
    times = action.start + np.arange(action.frames) / FPS
    motion = sample(clip, times, FPS)
    return Motion(motion.rotations, motion.root, FPS, action.name)
