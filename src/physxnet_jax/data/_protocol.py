"""The experiment's actions, as a table beside the motion files tells them."""

import csv
import dataclasses
import pathlib
import re

import numpy as np

from ..errors import MotionError
from ..motion import Motion, load_motion, sample

FPS = 30.0


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


def read_protocol(folder: str | pathlib.Path) -> list[Action]:
    """The actions listed in ``ACTIONS.csv``, with true rates from ``CLIPS.csv``.

    Args:
        folder: Where both tables and the motion files lie.

    Raises:
        MotionError: No table there.
    """
    folder = pathlib.Path(folder)
    table = folder / "ACTIONS.csv"
    if not table.is_file():
        raise MotionError.at(table, None, "no such file", "Name the folder that holds ACTIONS.csv")
    rates: dict[str, float] = {}
    clips = folder / "CLIPS.csv"
    if clips.is_file():
        with clips.open(newline="") as file:
            rates = {row["file"]: float(row["fps"]) for row in csv.DictReader(file)}
    with table.open(newline="") as file:
        return [
            Action(
                row["split"],
                row["action"],
                row["file"],
                float(row["start_s"]),
                int(row["frames_at_30fps"]),
                rates.get(row["file"]),
            )
            for row in csv.DictReader(file)
        ]


def load_action(folder: str | pathlib.Path, action: Action) -> Motion:
    """The frames of an action, at 30 a second, by spherical interpolation."""
    clip = load_motion(pathlib.Path(folder) / action.file, source_fps=action.fps)
    times = action.start + np.arange(action.frames) / FPS
    motion = sample(clip, times, FPS)
    return Motion(motion.rotations, motion.root, FPS, action.name)
