"""The human body: shape, pose and skin, independent of motion files."""

from ._align import (
    align_bones as align_bones,
    align_global as align_global,
    bone_directions as bone_directions,
    smallest_rotation as smallest_rotation,
    t_pose as t_pose,
)
from ._body import (
    NUM_BODY_VERTICES as NUM_BODY_VERTICES,
    Body as Body,
    load_body as load_body,
    triangulate as triangulate,
)
from ._kinematics import (
    blend_rotations as blend_rotations,
    forward_kinematics as forward_kinematics,
    linear_blend_skinning as linear_blend_skinning,
    skin_points as skin_points,
)
from ._register import (
    Registration as Registration,
    clothed_vertices as clothed_vertices,
    register_body as register_body,
)
from ._segments import (
    CALVES as CALVES,
    FOREARMS as FOREARMS,
    HANDS as HANDS,
    THIGHS as THIGHS,
    UPPER_ARMS as UPPER_ARMS,
    body_segments as body_segments,
)
from ._units import UNITS as UNITS, unit_of_person as unit_of_person
