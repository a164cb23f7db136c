"""Motion of the body: files, retargeting, resampling and built-in clips."""

from ._asf_amc import read_amc as read_amc
from ._bvh import read_bvh as read_bvh
from ._faults import slow_subject as slow_subject, sudden_turns as sudden_turns
from ._fit_motion import fit_motion as fit_motion
from ._gltf import (
    read_gltf as read_gltf,
    read_rig as read_rig,
    split_animation as split_animation,
)
from ._inspect import (
    MotionInspection as MotionInspection,
    declared_too_fast as declared_too_fast,
    inspect_motion as inspect_motion,
)
from ._load import (
    load_motion as load_motion,
    read_motion as read_motion,
    save_motion as save_motion,
)
from ._motion import (
    ROTATION_LENGTHS as ROTATION_LENGTHS,
    Motion as Motion,
    animate as animate,
    body_animation as body_animation,
    body_blocks as body_blocks,
    ground_point as ground_point,
    make_motion as make_motion,
    resample as resample,
    sample as sample,
)
from ._prepare import prepare_motion as prepare_motion, slice_motion as slice_motion
from ._procedural import CLIPS as CLIPS, procedural_clip as procedural_clip
from ._retarget import (
    foot_heights as foot_heights,
    joint_index as joint_index,
    retarget as retarget,
    stand_on_floor as stand_on_floor,
)
from ._retarget_to_rig import retarget_to_rig as retarget_to_rig
from ._skeletons import (
    JOINT_MAPS as JOINT_MAPS,
    LIMBS as LIMBS,
    find_joint_map as find_joint_map,
    read_joint_map as read_joint_map,
)
from ._transforms import (
    BLOCK as BLOCK,
    clip_transforms as clip_transforms,
    extrapolate_history as extrapolate_history,
    history_transforms as history_transforms,
    padded_block as padded_block,
    pose_transforms as pose_transforms,
)
from ._variants import (
    at_speed as at_speed,
    exaggerated as exaggerated,
    frames_at_speed as frames_at_speed,
    mirror_joints as mirror_joints,
    mirrored as mirrored,
    subdued as subdued,
    with_upper_body as with_upper_body,
)
