"""Dressing: the whole way from motion and garments to animated meshes."""

from ._blocks import dress_block as dress_block
from ._character import (
    Character as Character,
    load_character as load_character,
    make_character as make_character,
)
from ._cost import (
    Cost as Cost,
    mean_errors as mean_errors,
    network_costs as network_costs,
    network_errors as network_errors,
    other_costs as other_costs,
    present_devices as present_devices,
)
from ._dress import (
    METHODS as METHODS,
    DressedClip as DressedClip,
    Method as Method,
    dress as dress,
    fit_surface as fit_surface,
    unbound_wearable as unbound_wearable,
)
from ._dresser import (
    Clothed as Clothed,
    Dresser as Dresser,
    Precision as Precision,
    clothe as clothe,
    clothe_frame as clothe_frame,
    make_dresser as make_dresser,
    start_clothing as start_clothing,
    with_shape as with_shape,
)
from ._export import EXPORTED as EXPORTED, export_dresser as export_dresser
from ._ladder import (
    ALONE_AND_TOGETHER as ALONE_AND_TOGETHER,
    Choice as Choice,
    Rung as Rung,
    calibrate as calibrate,
    calibration_file as calibration_file,
    load_ladder as load_ladder,
    pick_rung as pick_rung,
    worn_key as worn_key,
)
from ._meshes import animated_meshes as animated_meshes
from ._method import (
    method_by_name as method_by_name,
    pushed_network as pushed_network,
    weights_folder as weights_folder,
)
from ._push_out import (
    SkinPatch as SkinPatch,
    make_patch as make_patch,
    push_out as push_out,
    skin_height as skin_height,
    tuck_in as tuck_in,
)
from ._scene_file import (
    SceneFile as SceneFile,
    load_scene as load_scene,
    make_scene as make_scene,
)
from ._skirt import SkirtPatch as SkirtPatch
from ._stages import Stage as Stage
from ._wanted_clip import wanted_clip as wanted_clip
