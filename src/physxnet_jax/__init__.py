"""Clothes on moving people, learned and differentiable, in JAX.

>>> import physxnet_jax as px
>>> clip = px.dress("walk", wear=["bottom"], method="lbs", frames=2)
>>> px.write_clip("/tmp/walk.npz", clip.meshes, clip.fps)[0].name
'walk.npz'
"""

import sys as _sys

from ._environment import (
    check_jaxlib as _check_jaxlib,
    keep_programs as _keep_programs,
    keeps_programs as _keeps_programs,
)
from ._version import __version__ as __version__

# A command is a process of its own; a program that imports this package decides for itself.
if _keeps_programs(_sys.argv):
    _keep_programs()

# `physxnet doctor` must be able to say what is wrong.
if _sys.argv[1:2] != ["doctor"]:
    _check_jaxlib()

from .body import Body as Body, load_body as load_body
from .dressing import (
    Clothed as Clothed,
    DressedClip as DressedClip,
    Dresser as Dresser,
    clothe as clothe,
    clothe_frame as clothe_frame,
    dress as dress,
    make_dresser as make_dresser,
    start_clothing as start_clothing,
)
from .errors import PhysXNetError as PhysXNetError
from .garment import Fabric as Fabric, Garment as Garment, template as template
from .io import (
    fit_garment as fit_garment,
    inspect_garment as inspect_garment,
    load_garment as load_garment,
    load_predictor as load_predictor,
    write_clip as write_clip,
)
from .models import (
    Predictor as Predictor,
    dress_frames as dress_frames,
    make_wearable as make_wearable,
    pad_clip as pad_clip,
)
from .motion import Motion as Motion, load_motion as load_motion
from .simulation import Scene as Scene, simulate as simulate
from .uv import bind as bind, make_atlas as make_atlas

__all__ = [
    "Body",
    "Clothed",
    "DressedClip",
    "Dresser",
    "Fabric",
    "Garment",
    "Motion",
    "PhysXNetError",
    "Predictor",
    "Scene",
    "__version__",
    "bind",
    "clothe",
    "clothe_frame",
    "dress",
    "dress_frames",
    "fit_garment",
    "inspect_garment",
    "load_body",
    "load_garment",
    "load_motion",
    "load_predictor",
    "make_atlas",
    "make_dresser",
    "make_wearable",
    "pad_clip",
    "simulate",
    "start_clothing",
    "template",
    "write_clip",
]
