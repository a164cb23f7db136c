"""Garments: templates, fitting and materials. Knows nothing of simulation."""

from ._decimate import decimate as decimate
from ._fit import (
    clearance as clearance,
    lift_out as lift_out,
    set_clearance as set_clearance,
    smoothing_matrix as smoothing_matrix,
)
from ._garment import (
    COTTON as COTTON,
    FABRICS as FABRICS,
    TEMPLATES as TEMPLATES,
    Fabric as Fabric,
    Garment as Garment,
    Template as Template,
    carried_weights as carried_weights,
)
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
from ._templates import (
    build_template as build_template,
    stored_arrays as stored_arrays,
    template as template,
)
