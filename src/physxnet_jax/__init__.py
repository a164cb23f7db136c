"""Clothes on moving people, learned and differentiable, in JAX.

>>> import physxnet_jax as px
>>> clip = px.dress("walk", wear=["bottom"], method="lbs", frames=2)
>>> px.write_clip("/tmp/walk.npz", clip.meshes, clip.fps)[0].name
'walk.npz'
"""

from ._environment import check_jaxlib as _check_jaxlib
from ._version import __version__ as __version__

_check_jaxlib()

from .body import Body as Body, load_body as load_body  # noqa: E402
from .dressing import DressedClip as DressedClip, dress as dress  # noqa: E402
from .errors import PhysXNetError as PhysXNetError  # noqa: E402
from .garment import Fabric as Fabric, Garment as Garment, template as template  # noqa: E402
from .io import (  # noqa: E402
    load_garment as load_garment,
    load_predictor as load_predictor,
    write_clip as write_clip,
)
from .models import (  # noqa: E402
    Predictor as Predictor,
    dress_frames as dress_frames,
    make_wearable as make_wearable,
    pad_clip as pad_clip,
)
from .motion import Motion as Motion, load_motion as load_motion  # noqa: E402
from .simulation import Scene as Scene, simulate as simulate  # noqa: E402
from .uv import bind as bind, make_atlas as make_atlas  # noqa: E402

__all__ = [
    "Body",
    "DressedClip",
    "Fabric",
    "Garment",
    "Motion",
    "PhysXNetError",
    "Predictor",
    "Scene",
    "__version__",
    "bind",
    "dress",
    "dress_frames",
    "load_body",
    "load_garment",
    "load_motion",
    "load_predictor",
    "make_atlas",
    "make_wearable",
    "pad_clip",
    "simulate",
    "template",
    "write_clip",
]
