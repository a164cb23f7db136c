"""Dressing: from motion and garments to animated meshes."""

from ._adapt import Adapted as Adapted, adapt as adapt
from ._adapt_task import AdaptConfig as AdaptConfig
from ._blocks import infer_clip as infer_clip, pose_clip as pose_clip
from ._character import (
    Character as Character,
    load_character as load_character,
    make_character as make_character,
    write_dressed_character as write_dressed_character,
)
from ._character_file import (
    CHARACTER_FORMATS as CHARACTER_FORMATS,
    read_character as read_character,
)
from ._clothe import (
    Clothed as Clothed,
    Stream as Stream,
    clothe as clothe,
    clothe_step as clothe_step,
    init_stream as init_stream,
    pad_frames as pad_frames,
)
from ._dress import (
    INFERENCE_STAGES as INFERENCE_STAGES,
    METHODS as METHODS,
    DressedClip as DressedClip,
    dress as dress,
)
from ._dresser import (
    Dresser as Dresser,
    Precision as Precision,
    make_dresser as make_dresser,
    with_body as with_body,
)
from ._export import EXPORTED as EXPORTED, export_dresser as export_dresser
from ._inference import Inference as Inference
from ._inspect import Inspection as Inspection, inspect_garment as inspect_garment
from ._inspect_character import (
    CharacterInspection as CharacterInspection,
    inspect_character as inspect_character,
    is_character as is_character,
)
from ._meshes import animated_meshes as animated_meshes
from ._pipeline import infer_block as infer_block
from ._repair import fit_garment as fit_garment
from ._scene_file import (
    load_scene as load_scene,
    make_scene as make_scene,
    write_scene as write_scene,
)
from ._scene_schema import attribute_notes as attribute_notes, scene_schema as scene_schema
from ._simulate import (
    EXTERNAL_ENGINES as EXTERNAL_ENGINES,
    Simulation as Simulation,
    run_simulation as run_simulation,
)
from ._stages import Stage as Stage
from ._variations import (
    with_cut as with_cut,
    with_fabric as with_fabric,
    with_shape as with_shape,
)
