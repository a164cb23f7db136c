"""Files in and out. Optional libraries are imported inside the functions."""

from ._character import CHARACTER_FORMATS as CHARACTER_FORMATS, read_character as read_character
from ._clip import (
    AnimatedMesh as AnimatedMesh,
    StillMesh as StillMesh,
    smooth_normals as smooth_normals,
)
from ._garment import GarmentReport as GarmentReport, load_garment as load_garment
from ._gltf import write_gltf as write_gltf
from ._html import write_html as write_html
from ._inspect import Inspection as Inspection, inspect_garment as inspect_garment
from ._mdd import read_mdd as read_mdd, write_mdd as write_mdd
from ._mend import fit_garment as fit_garment
from ._mesh_file import (
    GARMENT_FORMATS as GARMENT_FORMATS,
    read_mesh as read_mesh,
    split_part as split_part,
)
from ._obj import read_obj as read_obj, write_obj as write_obj
from ._pc2 import read_pc2 as read_pc2, write_pc2 as write_pc2
from ._usd import write_usd as write_usd
from ._weights import (
    DEFAULT as DEFAULT,
    MIRROR as MIRROR,
    RELAX as RELAX,
    list_weights as list_weights,
    load_predictor as load_predictor,
    read_card as read_card,
    save_mean as save_mean,
    save_predictor as save_predictor,
    split_ways as split_ways,
    weights_size as weights_size,
)
from ._write import EXTENSIONS as EXTENSIONS, check_output as check_output, write_clip as write_clip
