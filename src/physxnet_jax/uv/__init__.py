"""UV maps: the atlas, transference matrices, binding, body and garment maps."""

from ._atlas import Atlas as Atlas, make_atlas as make_atlas
from ._bind import (
    Binding as Binding,
    bind as bind,
    chart_mesh as chart_mesh,
    garment_map_rows as garment_map_rows,
    sampling_weights as sampling_weights,
)
from ._dress_body import dress_body as dress_body
from ._maps import (
    acceleration_maps as acceleration_maps,
    body_map as body_map,
    garment_map as garment_map,
    velocity_maps as velocity_maps,
)
from ._rasterise import rasterise as rasterise
from ._transference import Transference as Transference
