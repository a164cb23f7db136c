"""Preparation of motions for dressing and simulation: loading, resampling, slicing."""

import dataclasses
import numbers
import pathlib
from collections.abc import Mapping
from typing import Literal

from jaxtyping import Array, Float

from ..body import Body
from ..errors import MotionError
from ._load import load_motion
from ._motion import Motion, make_motion, resample
from ._retarget import stand_on_floor


def prepare_motion(
    motion: Motion | str | pathlib.Path,
    *,
    fps: float | None,
    body: Body,
    shape: Float[Array, " shapes"] | None = None,
    start: float = 0.0,
    frames: int | None = None,
    source_fps: float | None = None,
    skeleton: str | pathlib.Path | None = None,
    up: Literal["y", "z"] | None = None,
    joint_map: Mapping[str, str] | str | pathlib.Path | None = None,
) -> Motion:
    """Loads or resamples a motion, moves it to the floor for the body's shape, and slices it.

    Args:
        motion: A motion, a motion file, or the name of a built-in clip.
        fps: Frames per second; if None, the rate of a `Motion`, and 30 for others.
        body: The body.
        shape: Shape parameters; the default shape if None.
        start: Start time in the motion [s].
        frames: Keep only this many frames.
        source_fps: True rate of a motion file [1/s].
        skeleton: The ASF of an AMC file.
        up: Axis of the file that points up, as for `load_motion`.
        joint_map: Joint map of a motion file, as for `load_motion`.

    Raises:
        MotionError: The motion can't be read, fewer than one frame is requested, the start
            is outside the motion, or an option for motion files is given with a `Motion`.
    """
    if isinstance(motion, Motion):
        of_files = {"source_fps": source_fps, "skeleton": skeleton, "up": up}
        of_files |= {"joint_map": joint_map}
        given = [name for name, value in of_files.items() if value is not None]
        if given:
            raise MotionError(
                f"{given[0]} is for motion files, not for a loaded motion. Leave it out."
            )
        clip = make_motion(motion.rotations, motion.root, motion.fps, name=motion.name)
        clip = clip if fps in (None, clip.fps) else resample(clip, fps)
        if shape is not None:
            rest = body.rest_vertices(shape)
            clip = stand_on_floor(body, clip, rest)
    else:
        clip = load_motion(
            motion,
            fps=30.0 if fps is None else fps,
            source_fps=source_fps,
            skeleton=skeleton,
            up=up,
            joint_map=joint_map,
            body=body,
            shape=shape,
        )
    return slice_motion(clip, start, frames)[0]


def slice_motion(clip: Motion, start: float, frames: int | None) -> tuple[Motion, Motion]:
    """Cuts out a part of a motion; returns it and the frames before it.

    Args:
        clip: The motion.
        start: Start time of the part [s].
        frames: Keep only this many frames.

    Raises:
        MotionError: Fewer than one frame is requested, or the start is outside the motion.
    """
    if frames is not None and not (isinstance(frames, numbers.Integral) and frames >= 1):
        raise MotionError(f"frames is {frames!r}; it must be a whole number of at least one.")
    if not isinstance(start, numbers.Real):
        raise MotionError(f"start is {start!r}; it must be a number of seconds.")
    first = start * clip.fps
    if not 0.0 <= first < clip.num_frames:
        raise MotionError(
            f"start is {start} s, but {clip.name or 'the motion'} lasts from 0 to"
            f" {clip.num_frames / clip.fps:.2f} s."
        )
    begin = min(round(first), clip.num_frames - 1)
    end = clip.num_frames if frames is None else min(begin + frames, clip.num_frames)

    past = dataclasses.replace(clip, rotations=clip.rotations[:begin], root=clip.root[:begin])
    whole = (begin, end) == (0, clip.num_frames)
    return clip if whole else clip[begin:end], past
