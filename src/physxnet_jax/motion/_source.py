"""Motion as read from a file, before retargeting: any skeleton, any unit."""

import dataclasses
from typing import Literal

import numpy as np
from jaxtyping import Float

from ..errors import MotionError

MAX_JOINT_FRAMES = 6e6
"""Limit on frames times joints of a clip: eleven minutes at 120 fps with 75 joints."""

_FARTHEST = 1e9


def is_real(values: np.ndarray) -> bool:
    """Whether an array has a real dtype of at most 8 bytes, which float64 can hold."""
    return values.dtype.kind in "fiu" and values.dtype.itemsize <= 8


@dataclasses.dataclass(frozen=True)
class SourceClip:
    """A skeleton and its motion in the file's own units.

    Attributes:
        names: Joint names; parents come before children.
        parents: Parent of every joint, -1 for the root.
        offsets: Position of a joint in its parent's frame, shape [joints, 3].
        rotations: World rotation of every joint, shape [frames, joints, 3, 3].
        root: World position of the root, shape [frames, 3].
        fps: Frames per second, as declared by the file.
        name: Name of the clip.
        path: File that the clip was read from, for error messages.
        rest: World rotation of every joint in the skeleton's rest pose, shape
            [joints, 3, 3]; identity if omitted.
        shifts: Position of every joint in its parent's frame if it varies over time, shape
            [frames, joints, 3]; `offsets` in every frame if omitted.
        up: Axis that points up in the motion, if the user states it.

    Raises:
        MotionError: Positions too large for a skeleton in any unit.
    """

    names: tuple[str, ...]
    parents: tuple[int, ...]
    offsets: Float[np.ndarray, "joints 3"]
    rotations: Float[np.ndarray, "frames joints 3 3"]
    root: Float[np.ndarray, "frames 3"]
    fps: float
    name: str
    path: str
    rest: Float[np.ndarray, "joints 3 3"] | None = None
    shifts: Float[np.ndarray, "frames joints 3"] | None = None
    up: Literal["y", "z"] | None = None

    def __post_init__(self) -> None:
        # Sums of larger distances would lose the digits of a limb.
        for x in (self.offsets, self.root, self.shifts):
            if x is not None and (np.abs(x) > _FARTHEST).any():
                raise MotionError.at(
                    self.path,
                    None,
                    f"joints {float(np.abs(x).max()):.3g} units away from each other",
                    "Export it again",
                )

    def positions(self) -> Float[np.ndarray, "frames joints 3"]:
        """World positions of all joints."""
        out = np.zeros((*self.rotations.shape[:2], 3))
        for j, parent in enumerate(self.parents):
            if parent < 0:
                out[:, j] = self.root
            else:
                local = self.offsets[j][None] if self.shifts is None else self.shifts[:, j]
                step = (self.rotations[:, parent] @ local[:, :, None])[:, :, 0]
                out[:, j] = out[:, parent] + step
        return out

    def part(self, start: int, stop: int) -> "SourceClip":
        """Some successive frames."""
        shifts = None if self.shifts is None else self.shifts[start:stop]
        return dataclasses.replace(
            self, rotations=self.rotations[start:stop], root=self.root[start:stop], shifts=shifts
        )

    def turned(self, turn: Float[np.ndarray, "3 3"]) -> "SourceClip":
        """The clip with the whole world rotated, including its rest pose."""
        rest = self.rest_rotations()
        return dataclasses.replace(
            self, rotations=turn @ self.rotations, root=self.root @ turn.T, rest=turn @ rest
        )

    def rest_rotations(self) -> Float[np.ndarray, "joints 3 3"]:
        """World rotations of the rest pose."""
        return np.tile(np.eye(3), (len(self.names), 1, 1)) if self.rest is None else self.rest
