"""Steps after prediction: strain limiting, collision resolution, layers.

Each step is a pair ``prepare_x(outfit, inference) -> state | None`` (on the host, once) and
``apply_x(state, cloth, rotations, translations) -> cloth`` (pure). A step that isn't
requested prepares None and is absent from the compiled program.
"""

from ._collisions import (
    BodyCollider as BodyCollider,
    apply_collisions as apply_collisions,
    faces_at_rest as faces_at_rest,
    make_colliders as make_colliders,
    prepare_collisions as prepare_collisions,
    reshape_colliders as reshape_colliders,
    resolve_collisions_with_skin as resolve_collisions_with_skin,
    skin_clearance as skin_clearance,
)
from ._contacts import apply_contacts as apply_contacts
from ._layers import (
    Layer as Layer,
    apply_layers as apply_layers,
    layer_order as layer_order,
    prepare_layers as prepare_layers,
    resolve_layers as resolve_layers,
)
from ._outfit import Cloth as Cloth, Outfit as Outfit
from ._sites import (
    Sites as Sites,
    carry_clip as carry_clip,
    clip_at_sites as clip_at_sites,
    garment_at_sites as garment_at_sites,
    make_sites as make_sites,
)
from ._strain import (
    StrainLimits as StrainLimits,
    apply_strain as apply_strain,
    prepare_strain as prepare_strain,
    reshape_strain as reshape_strain,
)
