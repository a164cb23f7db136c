"""One door for every motion: a file of a known format or a built-in clip."""

import math
import pathlib
from collections.abc import Mapping

import numpy as np
from jaxtyping import Array, Float

from ..body import Body
from ..errors import MotionError
from ..files import whole_file
from ._asf_amc import read_amc
from ._bvh import read_bvh
from ._motion import Motion, make_motion, resample
from ._procedural import CLIPS, procedural_clip
from ._retarget import retarget


def load_motion(
    motion: str | pathlib.Path,
    *,
    fps: float | int | None = None,
    source_fps: float | int | None = None,
    skeleton: str | pathlib.Path | None = None,
    joint_map: Mapping[str, str] | None = None,
    body: Body | None = None,
    shape: Float[Array, " shapes"] | None = None,
) -> Motion:
    """A motion by file or by name.

    Args:
        motion: A `.bvh`, `.amc` or `.npz` file, or the name of a built-in clip.
        fps: Resample to this rate [1/s].
        source_fps: True rate of the file, where its header is wrong or silent (CMU
            subjects 60 and 61 say 120 and are 60).
        skeleton: The ASF of an AMC file.
        joint_map: Body joint to the file's joint, for a skeleton of unknown names.
        body: Body to retarget to; the built-in one by default.
        shape: Its shape parameters, whose proportions set how it stands and steps.

    Returns:
        The motion on the body's skeleton.

    Raises:
        MotionError: Unknown name or format, or a file that can't be read.

    Example:
        >>> load_motion("walk", fps=30).fps
        30.0
    """
    for name, rate in (("fps", fps), ("source_fps", source_fps)):
        if rate is not None and not (math.isfinite(rate) and rate > 0):
            raise MotionError(f"{name} is {rate}, expected a positive number.")
    path = pathlib.Path(motion)
    suffix = path.suffix.lower()
    if suffix == ".bvh":
        clip = retarget(read_bvh(path), body, joint_map=joint_map, shape=shape)
    elif suffix == ".amc":
        clip = retarget(read_amc(path, skeleton), body, joint_map=joint_map, shape=shape)
    elif suffix == ".npz":
        clip = _load_npz(path)
    elif str(motion) in CLIPS:
        clip = procedural_clip(str(motion), fps=float(fps or 30), body=body, shape=shape)
    else:
        raise MotionError(
            f"{motion}: neither a .bvh, .amc or .npz file nor a built-in clip ({', '.join(CLIPS)})."
        )
    if source_fps is not None:
        clip = make_motion(clip.rotations, clip.root, source_fps, name=clip.name)
    return clip if fps is None or fps == clip.fps else resample(clip, fps)


def save_motion(path: str | pathlib.Path, motion: Motion) -> None:
    """Writes a motion as `.npz` (rotations, root, fps), atomically."""
    with whole_file(path) as part, part.open("wb") as file:
        np.savez_compressed(
            file,
            rotations=np.asarray(motion.rotations),
            root=np.asarray(motion.root),
            fps=np.asarray(motion.fps),
        )


def _load_npz(path: pathlib.Path) -> Motion:
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as data:
            return make_motion(data["rotations"], data["root"], float(data["fps"]), name=path.stem)
    except MotionError:
        raise
    except Exception as error:
        raise MotionError.at(
            path,
            None,
            f"not a motion archive ({error})",
            "It needs arrays rotations [frames, joints, 4], root [frames, 3] and fps",
        ) from error
