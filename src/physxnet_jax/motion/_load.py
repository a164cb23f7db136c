"""Loading of motions: files of all supported formats, and built-in clips."""

import dataclasses
import math
import pathlib
from collections.abc import Mapping
from typing import Literal

import numpy as np
from jaxtyping import Array, Float

from ..body import Body, load_body
from ..errors import MotionError, check_type
from ..files import add_inputs, atomic_write, is_file, read_arrays
from ..io import GLTF_FORMATS
from ._amass import AMASS_ARRAYS, amass_clip, is_amass
from ._asf_amc import read_amc
from ._bvh import read_bvh
from ._gltf import read_gltf, split_animation
from ._motion import Motion, make_motion, resample
from ._pickle import read_pickled_arrays
from ._procedural import CLIPS, procedural_clip
from ._retarget import retarget, stand_on_floor
from ._skeletons import read_joint_map
from ._source import SourceClip, is_real


def load_motion(
    motion: str | pathlib.Path,
    *,
    fps: float | int | None = None,
    source_fps: float | int | None = None,
    skeleton: str | pathlib.Path | None = None,
    up: Literal["y", "z"] | None = None,
    joint_map: Mapping[str, str] | str | pathlib.Path | None = None,
    body: Body | None = None,
    shape: Float[Array, " shapes"] | None = None,
) -> Motion:
    """Loads a motion from a file, or a built-in clip by name.

    Args:
        motion: A file or the name of a built-in clip. Files are `.bvh`, `.amc` (with its
            ASF), `.glb`, `.gltf` or `.vrma` with an animation (the longest, or
            ``file.glb#Run``), and `.npz` written by `save_motion`, from AMASS (SMPL,
            SMPL+H or SMPL-X poses) or with the arrays of AIST++ (`.pkl` too) or 4D-Humans.
        fps: Resample to this rate [1/s].
        source_fps: True rate of the file [1/s], if its header is wrong or has none (files
            of CMU's subjects 60 and 61 declare 120 and have 60).
        skeleton: The ASF of an AMC file.
        up: Axis of the file that points up; found from the skeleton if omitted.
        joint_map: Body joint to the file's joint, for a skeleton with unknown names, or
            a TOML file of such pairs (`read_joint_map`).
        body: Body to retarget to; the built-in one by default.
        shape: Its shape parameters. The body's proportions set its height above the floor
            and the length of its steps. A clip from `save_motion` is moved to the floor
            but its steps aren't scaled.

    Returns:
        The motion on the body's skeleton.

    Raises:
        MotionError: Unknown name or format, or a file that can't be read.

    Example:
        >>> load_motion("walk", fps=30).fps
        30.0
    """
    read = read_motion(
        motion, fps=fps, source_fps=source_fps, skeleton=skeleton, up=up, body=body, shape=shape
    )
    clip = fitted_motion(read, body, joint_map=joint_map, shape=shape)
    return clip if fps is None or fps == clip.fps else resample(clip, fps)


def fitted_motion(
    read: SourceClip | Motion,
    body: Body | None = None,
    *,
    joint_map: Mapping[str, str] | str | pathlib.Path | None = None,
    shape: Float[Array, " shapes"] | None = None,
) -> Motion:
    """Retargets the result of `read_motion` to the body's skeleton, if necessary."""
    if isinstance(read, Motion):
        if joint_map is not None:
            raise MotionError(
                f"joint_map is for skeletons with other names; '{read.name}' has the body's."
                " Leave it out."
            )
        if shape is None:
            return read
        body = load_body() if body is None else body
        return stand_on_floor(body, read, body.rest_vertices(shape))
    if isinstance(joint_map, str | pathlib.Path):
        joint_map = read_joint_map(joint_map)
    return retarget(read, body, joint_map=joint_map, shape=shape)


def read_motion(
    motion: str | pathlib.Path,
    *,
    fps: float | int | None = None,
    source_fps: float | int | None = None,
    skeleton: str | pathlib.Path | None = None,
    up: Literal["y", "z"] | None = None,
    body: Body | None = None,
    shape: Float[Array, " shapes"] | None = None,
) -> SourceClip | Motion:
    """Reads a motion without retargeting; a `Motion` if it is on the body's skeleton already.

    Args:
        motion: As for `load_motion`.
        fps: Rate at which a built-in clip is computed [1/s].
        source_fps: True rate of the file.
        skeleton: The ASF of an AMC file.
        up: Axis of the file that points up, if stated.
        body: Body of built-in clips.
        shape: Its shape parameters.
    """
    check_type(
        motion, (str, pathlib.PurePath), "A motion is a file, the name of a clip, or a Motion."
    )
    for name, rate in (("fps", fps), ("source_fps", source_fps)):
        if rate is not None and not (math.isfinite(rate) and rate > 0):
            raise MotionError(f"{name} is {rate}, expected a positive number.")
    if up not in (None, "y", "z"):
        raise MotionError(f"up is '{up}', expected 'y' or 'z'.")
    path, animation = split_animation(motion)
    suffix = path.suffix.lower()
    if skeleton is not None and suffix != ".amc":
        raise MotionError(f"{motion}: a skeleton (.asf) is for .amc files. Leave it out.")
    if suffix == ".bvh":
        read = read_bvh(path)
    elif suffix == ".amc":
        read = read_amc(path, skeleton)
    elif suffix in GLTF_FORMATS:
        read = read_gltf(path, animation)
    elif suffix in (".npz", ".pkl"):
        read = _read_npz(path, source_fps, up)
    elif str(motion) in CLIPS:
        if source_fps is not None:
            raise MotionError(
                f"source_fps is the true rate of a file; '{motion}' is computed at any rate."
                " Leave it out."
            )
        if up is not None:
            raise MotionError(f"up is the axis of a file; '{motion}' has Y up. Leave it out.")
        return procedural_clip(str(motion), fps=float(fps or 30), body=body, shape=shape)
    elif suffix == ".fbx":
        raise MotionError.at(
            path, None, "FBX isn't supported", "Export BVH or glTF, for example from Blender"
        )
    else:
        raise MotionError(
            f"{motion}: neither a .bvh, .amc, .glb, .gltf, .vrma, .npz or .pkl file nor a built-in"
            " clip"
            f" ({', '.join(CLIPS)})."
        )
    if up is not None:
        if isinstance(read, Motion):
            raise MotionError(f"{motion}: 'up' is for other skeletons; here Y is up. Leave it out.")
        read = dataclasses.replace(read, up=up)
    return read if source_fps is None else dataclasses.replace(read, fps=float(source_fps))


def save_motion(path: str | pathlib.Path, motion: Motion) -> None:
    """Writes a motion as `.npz` (rotations, root, fps), atomically."""
    with atomic_write(path) as part, part.open("wb") as file:
        np.savez_compressed(
            file,
            rotations=np.asarray(motion.rotations),
            root=np.asarray(motion.root),
            fps=np.asarray(motion.fps),
        )


def _read_npz(
    path: pathlib.Path, source_fps: float | int | None, up: Literal["y", "z"] | None
) -> Motion | SourceClip:
    if not is_file(path):
        raise MotionError.at(path, None, "no such file", "Check the path")
    add_inputs(path)
    try:
        if path.suffix.lower() == ".pkl":
            data = read_pickled_arrays(path, AMASS_ARRAYS)
        else:
            data = read_arrays(path, ("rotations", "root", "fps", *AMASS_ARRAYS))
    except ValueError as error:
        raise _not_motion(path, str(error)) from error
    if is_amass(data):
        return amass_clip(data, path, source_fps, up)
    if not {"rotations", "root", "fps"} <= data.keys() or data["fps"].size != 1:
        raise _not_motion(path, f"it holds {', '.join(sorted(data)) or 'nothing known'}")
    if not all(is_real(data[k]) for k in ("rotations", "root", "fps")):
        raise _not_motion(path, ", ".join(f"{k} of {x.dtype}" for k, x in data.items()))
    try:
        rate = float(data["fps"].reshape(()))
        return make_motion(data["rotations"], data["root"], rate, name=path.stem)
    except (TypeError, ValueError) as error:
        if isinstance(error, MotionError):
            raise
        raise _not_motion(path, str(error)) from error


def _not_motion(path: pathlib.Path, problem: str) -> MotionError:
    return MotionError.at(
        path,
        None,
        f"not a motion archive ({problem[:200]})",
        "It needs arrays rotations [frames, joints, 4], root [frames, 3] and fps, or those of"
        " AMASS (poses, trans, mocap_framerate), AIST++ (smpl_poses, smpl_trans) or 4D-Humans"
        " (global_orient, body_pose)",
    )
