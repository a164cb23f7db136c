"""A motion as its file tells it: any skeleton, any unit, before retargeting."""

import dataclasses

import numpy as np
from jaxtyping import Float

from ..errors import MotionError

MAX_JOINT_FRAMES = 6e6
"""Frames times joints that a clip may have: eleven minutes at 120 fps of 75 joints."""

_FARTHEST = 1e9
_BROADCAST = tuple(k * 1000.0 / 1001.0 for k in (24, 30, 48, 60, 120))


def nominal_rate(fps: float) -> float:
    """The rate that a file means by a rounded one [1/s]: a whole one or a broadcaster's.

    Example:
        >>> nominal_rate(1 / 0.0083333), nominal_rate(1 / 0.0333)
        (120.0, 30.0)
        >>> round(nominal_rate(29.97), 5)
        29.97003
    """
    nearest = min((float(round(fps)), *_BROADCAST), key=lambda r: abs(r - fps))
    return nearest if nearest > 0 and abs(nearest - fps) < 0.05 else fps


def is_real(values: np.ndarray) -> bool:
    """Whether an array of a file holds plain numbers, which float64 can hold."""
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
        fps: Frames a second, as the file says.
        name: Name of the clip.
        path: Where it was read from, for errors.
        rest: World rotation of every joint in the skeleton's rest pose, shape
            [joints, 3, 3]; no rotation at all if omitted.
        shifts: Position of every joint in its parent's frame where it changes, shape
            [frames, joints, 3]; `offsets` all the time if omitted.

    Raises:
        MotionError: Places that no skeleton has in any unit.
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

    def __post_init__(self) -> None:
        # Sums of what is farther away keep no digit of a limb.
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

    def turned(self, turn: Float[np.ndarray, "3 3"]) -> "SourceClip":
        """The same clip with the whole world rotated, its rest pose too."""
        rest = self.rest_rotations()
        return dataclasses.replace(
            self, rotations=turn @ self.rotations, root=self.root @ turn.T, rest=turn @ rest
        )

    def rest_rotations(self) -> Float[np.ndarray, "joints 3 3"]:
        """World rotations of the rest pose."""
        return np.tile(np.eye(3), (len(self.names), 1, 1)) if self.rest is None else self.rest
