"""The motion that is dressed or simulated, from what people name."""

import dataclasses
import pathlib
from collections.abc import Mapping

from jaxtyping import Array, Float

from ..body import Body
from ..errors import MotionError
from ..motion import Motion, load_motion, make_motion, resample, stand_on_floor


def wanted_clip(
    motion: Motion | str | pathlib.Path,
    *,
    fps: float | None,
    body: Body,
    shape: Float[Array, " shapes"] | None = None,
    start: float = 0.0,
    frames: int | None = None,
    source_fps: float | None = None,
    skeleton: str | pathlib.Path | None = None,
    joint_map: Mapping[str, str] | str | pathlib.Path | None = None,
) -> Motion:
    """A motion at a rate, of a length, on the floor beneath a body of a shape.

    Args:
        motion: A motion, a motion file, or the name of a built-in clip.
        fps: Frames a second; a `Motion`'s own if None, else 30.
        body: The body.
        shape: Shape parameters; the default shape if None.
        start: Where in the motion to begin [s].
        frames: Keep only this many frames.
        source_fps: True rate of a motion file [1/s].
        skeleton: The ASF of an AMC file.
        joint_map: Joint names of a motion file.

    Raises:
        MotionError: What can't be read; fewer than one frame; a start behind the end; what
            is said of a file where there is none.
    """
    if isinstance(motion, Motion):
        of_files = {"source_fps": source_fps, "skeleton": skeleton, "joint_map": joint_map}
        told = [name for name, value in of_files.items() if value is not None]
        if told:
            raise MotionError(
                f"{told[0]} is for motion files; this motion is loaded. Leave it out."
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
            joint_map=joint_map,
            body=body,
            shape=shape,
        )
    return cut_clip(clip, start, frames)[0]


def cut_clip(clip: Motion, start: float, frames: int | None) -> tuple[Motion, Motion]:
    """A part of a motion, and what of it comes before.

    Args:
        clip: The motion.
        start: Where in it to begin [s].
        frames: Keep only this many frames.

    Raises:
        MotionError: Fewer than one frame; a start behind the end.
    """
    if frames is not None and frames < 1:
        raise MotionError(f"frames is {frames}; ask for at least one.")
    first = start * clip.fps
    if not 0.0 <= first < clip.num_frames:
        raise MotionError(
            f"start is {start} s, but {clip.name or 'the motion'} lasts from 0 to"
            f" {clip.num_frames / clip.fps:.2f} s."
        )
    begin = min(round(first), clip.num_frames - 1)
    end = clip.num_frames if frames is None else min(begin + frames, clip.num_frames)

    def part(kept: slice) -> Motion:
        return dataclasses.replace(clip, rotations=clip.rotations[kept], root=clip.root[kept])

    whole = (begin, end) == (0, clip.num_frames)
    return clip if whole else part(slice(begin, end)), part(slice(0, begin))
