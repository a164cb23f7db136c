"""Garments: templates, fitting and materials, independent of simulation."""

from ._align import align_to_template as align_to_template, most_alike as most_alike
from ._decimate import decimate as decimate
from ._fabric import fabric_of as fabric_of, find_fabric as find_fabric
from ._fit import clearance as clearance, lift_out as lift_out
from ._garment import (
    FABRICS as FABRICS,
    TEMPLATES as TEMPLATES,
    Fabric as Fabric,
    Garment as Garment,
    Template as Template,
)
from ._holds import holding_loops as holding_loops
from ._load import (
    ELSEWHERE as ELSEWHERE,
    HANGS as HANGS,
    LONG as LONG,
    NEAREST as NEAREST,
    carried as carried,
    garment_of as garment_of,
    guess_template as guess_template,
    hangs_off as hangs_off,
    load_garment as load_garment,
    load_outfit as load_outfit,
    place_mesh as place_mesh,
)
from ._locate import (
    Hints as Hints,
    Placement as Placement,
    locate_on_body as locate_on_body,
)
from ._openings import Opening as Opening
from ._refine import refine_garment as refine_garment
from ._repair import (
    MeshHealth as MeshHealth,
    clean as clean,
    mesh_health as mesh_health,
    orient as orient,
    polygons_left as polygons_left,
    subdivide as subdivide,
    weld as weld,
)
from ._sheet import (
    free_garment as free_garment,
    grid_faces as grid_faces,
    square_sheet as square_sheet,
)
from ._skinned import (
    SkinnedGarment as SkinnedGarment,
    make_skinned as make_skinned,
    skin_garment as skin_garment,
)
from ._templates import (
    build_template as build_template,
    stored_arrays as stored_arrays,
    template as template,
)
from ._wear import (
    WearItem as WearItem,
    parse_wear as parse_wear,
    with_default_fabric as with_default_fabric,
    with_fabric as with_fabric,
    with_made_on as with_made_on,
)
from .tailoring import (
    DEFAULT_KINDS as DEFAULT_KINDS,
    KINDS as KINDS,
    MEASURES as MEASURES,
    Kind as Kind,
    cut_vertices as cut_vertices,
    resolve_measures as resolve_measures,
    tailor as tailor,
)
