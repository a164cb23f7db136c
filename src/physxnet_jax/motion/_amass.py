"""Reader of AMASS clips: poses of the SMPL family, read without an SMPL model."""

import dataclasses
import pathlib
from collections.abc import Mapping
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from ..errors import MotionError
from ._source import MAX_JOINT_FRAMES, SourceClip, is_real

AMASS_ARRAYS = (
    *("trans", "poses", "root_orient", "pose_body"),
    *("smpl_trans", "smpl_poses", "smpl_scaling"),
    *("transl", "global_orient", "body_pose"),
    *("mocap_framerate", "mocap_frame_rate", "fps"),
)
"""Arrays that are read; shape, gender and soft-tissue arrays are not."""

# Rotation vectors with a component beyond this are rejected [rad].
_MAX_ROTATION = 1e6

# The person travels along Y over a floor normal to Z if the lowest joint moves farther than
# _TRAVELLED along Y and less than _LEVEL along Z [m].
_TRAVELLED, _LEVEL = 0.3, 0.1

# Rates of datasets whose files state none [1/s].
_RATES = {"smpl_poses": 60.0, "body_pose": 30.0}

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


def is_amass(arrays: Mapping[str, np.ndarray]) -> bool:
    """Whether the arrays are poses of the SMPL family, under the names of a known dataset."""
    return bool({"trans", "smpl_poses", "body_pose", "poses"} & arrays.keys())


def amass_clip(
    arrays: Mapping[str, np.ndarray],
    path: pathlib.Path,
    source_fps: float | int | None = None,
    up: Literal["y", "z"] | None = None,
) -> SourceClip:
    """A clip from the arrays of an AMASS file, or of AIST++ or 4D-Humans.

    Args:
        arrays: `trans` [frames, 3] in metres; `poses`, axis-angle, [frames, 66 or more] or
            [frames, 22 or more, 3], the first 22 joints as SMPL orders them, or rotation
            matrices [frames, joints, 3, 3]; instead of `poses`, `root_orient` [frames, 3]
            and `pose_body` [frames, 63]; `mocap_framerate`, `mocap_frame_rate` or `fps`.
            AIST++ has `smpl_poses`, `smpl_trans` and `smpl_scaling`, which divides the
            latter, and 60 frames per second; 4D-Humans has `global_orient` and `body_pose`,
            perhaps `transl`, and no rate, which is then 30.
        path: The file of the arrays, for error messages and the clip's name.
        source_fps: True rate, if the file states none.
        up: Axis that points up, if the user states it.

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
        Mahmood et al., AMASS: Archive of Motion Capture as Surface Shapes (2019); Li et al.,
        AI Choreographer (2021), for AIST++; Goel et al., Humans in 4D (2023).
    """
    arrays = _named_as_amass(arrays, path)
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
        float(source_fps) if source_fps is not None else _rate(arrays, path),
        path.stem,
        str(path),
        rest=np.tile(np.eye(3), (joints, 1, 1)),
    )
    if up is not None:
        return clip
    degrees = _turn_to_y_up(clip, camera="body_pose" in arrays)
    if not degrees:
        return clip
    # The rest pose of the skeleton already has Y up.
    turn = Rotation.from_euler("X", degrees, degrees=True).as_matrix()
    return dataclasses.replace(clip, rotations=turn @ world, root=place @ turn.T)


def _named_as_amass(
    arrays: Mapping[str, np.ndarray], path: pathlib.Path
) -> Mapping[str, np.ndarray]:
    """The arrays of other datasets under the names of AMASS, poses as rotation vectors."""
    out = dict(arrays)
    if "smpl_poses" in arrays:
        scale = arrays.get("smpl_scaling", np.ones(1))
        trans = arrays.get("smpl_trans")
        if trans is None or scale.size != 1 or not (is_real(scale) and is_real(trans)):
            raise _broken(path, "smpl_poses without smpl_trans and smpl_scaling")
        size = float(scale.reshape(()))
        if not 1e-6 < size < 1e6:
            raise _broken(path, f"smpl_scaling is {size}")
        out |= {"poses": _as_vectors(arrays["smpl_poses"], path), "trans": trans / size}
    elif "body_pose" in arrays:
        parts = [arrays.get("global_orient"), arrays["body_pose"]]
        if parts[0] is None:
            raise _broken(path, "body_pose without global_orient")
        parts = [_as_vectors(p, path) for p in parts]
        if len({len(p) for p in parts}) > 1:
            raise _broken(path, f"global_orient {parts[0].shape}, body_pose {parts[1].shape}")
        out["poses"] = np.concatenate(parts, axis=1)
        out["trans"] = arrays.get("transl", arrays.get("trans", np.zeros((len(parts[0]), 3))))
    elif "poses" in arrays:
        out["poses"] = _as_vectors(arrays["poses"], path)
    if "trans" not in out:
        raise _broken(path, "poses without trans")
    for name, rate in _RATES.items():
        if name in arrays:
            out.setdefault("fps", np.array(rate))
    return out


def _as_vectors(poses: np.ndarray, path: pathlib.Path) -> np.ndarray:
    """Poses as rotation vectors, [frames, 3 joints], from any of their usual shapes."""
    if poses.ndim == 4 and poses.shape[2:] == (3, 3):
        if not is_real(poses) or not len(poses) or not np.isfinite(poses).all():
            raise _broken(path, f"rotation matrices {poses.shape} of {poses.dtype}, or not finite")
        try:
            turns = Rotation.from_matrix(poses.reshape(-1, 3, 3).astype(float))
        except ValueError as error:
            raise _broken(path, f"rotation matrices: {error}") from None
        return turns.as_rotvec().reshape(len(poses), -1)
    if poses.ndim == 3 and poses.shape[2] == 3:
        return poses.reshape(len(poses), -1)
    return poses


def _turn_to_y_up(clip: SourceClip, *, camera: bool) -> float:
    """Rotation about X to Y up [degrees].

    Z is up if the person stands along Z on average, or travels along Y; Y may point down in
    the frame of a camera.
    """
    up = clip.rotations[:, 0, :, 1].mean(axis=0)
    if camera and up[1] < -max(abs(up[2]), 0.5):
        return 180.0
    if up[2] > up[1]:
        return -90.0
    lowest = clip.positions().min(axis=1)
    few = max(1, len(lowest) // 5)
    gone = np.abs(np.median(lowest[-few:], axis=0) - np.median(lowest[:few], axis=0))
    return -90.0 if gone[1] > _TRAVELLED and gone[2] < _LEVEL else 0.0


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
