"""Reader of AMASS clips: poses of the SMPL family, read without an SMPL model."""

import dataclasses
import pathlib
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from ..errors import MotionError
from ._source import MAX_JOINT_FRAMES, SourceClip, is_real

AMASS_ARRAYS = (
    "trans",
    "poses",
    "root_orient",
    "pose_body",
    "mocap_framerate",
    "mocap_frame_rate",
    "fps",
)
"""Arrays that are read; shape, gender and soft-tissue arrays are not."""

# Rotation vectors with a component beyond this are rejected [rad].
_MAX_ROTATION = 1e6

# The person travels along Y over a floor normal to Z if the lowest joint moves farther than
# _TRAVELLED along Y and less than _LEVEL along Z [m].
_TRAVELLED, _LEVEL = 0.3, 0.1

# Joint, its parent, and its offset from the parent on a person of average build [m].
_FIGURE: tuple[tuple[str, str | None, tuple[float, float, float]], ...] = (
    ("pelvis", None, (0.0, 0.0, 0.0)),
    ("left_hip", "pelvis", (0.07, -0.09, 0.0)),
    ("right_hip", "pelvis", (-0.07, -0.09, 0.0)),
    ("spine1", "pelvis", (0.0, 0.11, 0.0)),
    ("left_knee", "left_hip", (0.0, -0.39, 0.0)),
    ("right_knee", "right_hip", (0.0, -0.39, 0.0)),
    ("spine2", "spine1", (0.0, 0.13, 0.0)),
    ("left_ankle", "left_knee", (0.0, -0.41, 0.0)),
    ("right_ankle", "right_knee", (0.0, -0.41, 0.0)),
    ("spine3", "spine2", (0.0, 0.06, 0.0)),
    ("left_foot", "left_ankle", (0.0, -0.06, 0.12)),
    ("right_foot", "right_ankle", (0.0, -0.06, 0.12)),
    ("neck", "spine3", (0.0, 0.21, 0.0)),
    ("left_collar", "spine3", (0.08, 0.12, 0.0)),
    ("right_collar", "spine3", (-0.08, 0.12, 0.0)),
    ("head", "neck", (0.0, 0.08, 0.03)),
    ("left_shoulder", "left_collar", (0.10, 0.03, 0.0)),
    ("right_shoulder", "right_collar", (-0.10, 0.03, 0.0)),
    ("left_elbow", "left_shoulder", (0.26, 0.0, 0.0)),
    ("right_elbow", "right_shoulder", (-0.26, 0.0, 0.0)),
    ("left_wrist", "left_elbow", (0.25, 0.0, 0.0)),
    ("right_wrist", "right_elbow", (-0.25, 0.0, 0.0)),
)


def amass_clip(arrays: Mapping[str, np.ndarray], path: pathlib.Path) -> SourceClip:
    """A clip from the arrays of an AMASS file.

    Args:
        arrays: `trans` [frames, 3] in metres; `poses` [frames, 66 or more], axis-angle,
            the first 22 joints as SMPL orders them, or `root_orient` [frames, 3] and
            `pose_body` [frames, 63]; `mocap_framerate`, `mocap_frame_rate` or `fps`.
        path: The file of the arrays, for error messages and the clip's name.

    Returns:
        The clip on a skeleton of average build whose rest pose is a T-pose, Y up.

    Raises:
        MotionError: Arrays are missing, have other shapes, or aren't finite.

    Note:
        Shape parameters are ignored, since they need an SMPL model. At rest, the limbs of
        SMPL bodies differ from an exact T-pose by a few degrees, and the clip's limbs are
        off by as much. Z is up unless the person stands along Y on average and doesn't
        travel along Y over a floor normal to Z.

    References:
        Mahmood et al., AMASS: Archive of Motion Capture as Surface Shapes (2019).
    """
    poses = arrays.get("poses")
    if poses is None and {"root_orient", "pose_body"} <= arrays.keys():
        parts = (arrays["root_orient"], arrays["pose_body"])
        if any(p.ndim != 2 or len(p) != len(parts[0]) for p in parts):
            raise _broken(path, f"root_orient {parts[0].shape}, pose_body {parts[1].shape}")
        if not all(map(is_real, parts)):
            raise _broken(path, f"root_orient {parts[0].dtype}, pose_body {parts[1].dtype}")
        poses = np.concatenate(parts, axis=1)
    if poses is None:
        raise _broken(path, "trans without poses")
    trans = arrays["trans"]
    joints = len(_FIGURE)
    if poses.ndim != 2 or poses.shape[1] < 3 * joints or trans.shape != (len(poses), 3):
        raise _broken(path, f"poses {poses.shape}, trans {trans.shape}")
    if len(poses) == 0:
        raise _broken(path, "no frames")
    if len(poses) * joints > MAX_JOINT_FRAMES:
        raise _broken(path, f"{len(poses):,} frames are too many, cut the clip")
    if not (is_real(poses) and is_real(trans)):
        raise _broken(path, f"poses are {poses.dtype}, trans {trans.dtype}")
    turns = poses[:, : 3 * joints].astype(np.float64)
    place = trans.astype(np.float64)
    bad = ~((np.abs(turns) < _MAX_ROTATION).all(axis=1) & np.isfinite(place).all(axis=1))
    if bad.any():
        raise MotionError.at(
            path,
            None,
            f"frame {int(np.argmax(bad))} is not finite or out of range",
            "Cut the frame out or interpolate over it",
        )
    names = tuple(name for name, _, _ in _FIGURE)
    parents = tuple(names.index(p) if p else -1 for _, p, _ in _FIGURE)
    local = Rotation.from_rotvec(turns.reshape(-1, 3)).as_matrix()
    world = _chained(local.reshape(len(turns), joints, 3, 3), parents)
    offsets = np.array([xyz for _, _, xyz in _FIGURE])
    clip = SourceClip(
        names,
        parents,
        offsets,
        world,
        place,
        _rate(arrays, path),
        path.stem,
        str(path),
        rest=np.tile(np.eye(3), (joints, 1, 1)),
    )
    if not _z_is_up(clip):
        return clip
    # The rest pose of the skeleton already has Y up.
    turn = Rotation.from_euler("X", -90, degrees=True).as_matrix()
    return dataclasses.replace(clip, rotations=turn @ world, root=place @ turn.T)


def _z_is_up(clip: SourceClip) -> bool:
    """Whether Z is up: the person stands along Z on average, or travels along Y."""
    up = clip.rotations[:, 0, :, 1].mean(axis=0)
    if up[2] > up[1]:
        return True
    lowest = clip.positions().min(axis=1)
    few = max(1, len(lowest) // 5)
    gone = np.abs(np.median(lowest[-few:], axis=0) - np.median(lowest[:few], axis=0))
    return bool(gone[1] > _TRAVELLED and gone[2] < _LEVEL)


def _chained(
    local: Float[np.ndarray, "frames joints 3 3"], parents: tuple[int, ...]
) -> Float[np.ndarray, "frames joints 3 3"]:
    world = local.copy()
    for j, parent in enumerate(parents):
        if parent >= 0:
            world[:, j] = world[:, parent] @ local[:, j]
    return world


def _rate(arrays: Mapping[str, np.ndarray], path: pathlib.Path) -> float:
    for name in ("mocap_framerate", "mocap_frame_rate", "fps"):
        if name in arrays and arrays[name].size == 1 and arrays[name].dtype.kind in "fiu":
            rate = float(arrays[name].reshape(()))
            if 1.0 <= rate <= 2000.0:
                return rate
            raise _broken(path, f"{name} is {rate}")
    raise _broken(path, "no mocap_framerate")


def _broken(path: pathlib.Path, problem: str) -> MotionError:
    return MotionError.at(
        path,
        None,
        f"not an AMASS clip: {problem}",
        f"Expected poses [frames, {3 * len(_FIGURE)} or more], trans [frames, 3] and"
        " mocap_framerate",
    )
