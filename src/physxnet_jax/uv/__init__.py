"""UV maps: the atlas, transference matrices, binding, body and garment maps."""

from ._atlas import Atlas as Atlas, make_atlas as make_atlas
from ._bind import (
    Binding as Binding,
    bind as bind,
    garment_map_rows as garment_map_rows,
    hit_rate as hit_rate,
)
from ._conditions import CONDITIONS as CONDITIONS, condition_maps as condition_maps
from ._dress_body import dress_body as dress_body
from ._maps import (
    acceleration_maps as acceleration_maps,
    body_map as body_map,
    cloth_offsets as cloth_offsets,
    velocity_maps as velocity_maps,
)
from ._paper import body_maps as body_maps, garment_map as garment_map, transference as transference
from ._rasterise import rasterise as rasterise
from ._transference import Transference as Transference
