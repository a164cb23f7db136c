"""A motion as its file tells it: any skeleton, any unit, before retargeting."""

import dataclasses

import numpy as np
from jaxtyping import Float


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
    """

    names: tuple[str, ...]
    parents: tuple[int, ...]
    offsets: Float[np.ndarray, "joints 3"]
    rotations: Float[np.ndarray, "frames joints 3 3"]
    root: Float[np.ndarray, "frames 3"]
    fps: float
    name: str
    path: str

    def positions(self) -> Float[np.ndarray, "frames joints 3"]:
        """World positions of all joints."""
        out = np.zeros((*self.rotations.shape[:2], 3))
        for j, parent in enumerate(self.parents):
            if parent < 0:
                out[:, j] = self.root
            else:
                step = self.rotations[:, parent] @ self.offsets[j]
                out[:, j] = out[:, parent] + step
        return out
