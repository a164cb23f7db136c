"""Clothes on moving people, learned and differentiable, in JAX.

>>> import physxnet_jax as px
>>> clip = px.dress("walk", wear=["bottom"], method="lbs", frames=2)
>>> px.write_clip("/tmp/walk.npz", clip.meshes, clip.fps)[0].name
'walk.npz'
"""

import importlib as _importlib
import sys as _sys
from typing import TYPE_CHECKING as _TYPE_CHECKING

from ._environment import (
    check_jaxlib as _check_jaxlib,
    is_command as _is_command,
    keep_programs as _keep_programs,
    keeps_programs as _keeps_programs,
)
from ._version import __version__ as __version__

# A command is a process of its own; a program that imports this package decides for itself.
if _keeps_programs(_sys.argv):
    _keep_programs()

# `physxnet doctor` must be able to say what is wrong.
if not (_is_command(_sys.argv) and _sys.argv[1:2] == ["doctor"]):
    _check_jaxlib()

if _TYPE_CHECKING:
    from .body import Body as Body, load_body as load_body
    from .dressing import (
        Character as Character,
        Clothed as Clothed,
        DressedClip as DressedClip,
        Dresser as Dresser,
        clothe as clothe,
        clothe_frame as clothe_frame,
        dress as dress,
        load_character as load_character,
        make_dresser as make_dresser,
        start_clothing as start_clothing,
        with_shape as with_shape,
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
    from .motion import (
        Motion as Motion,
        inspect_motion as inspect_motion,
        load_motion as load_motion,
    )
    from .simulation import Scene as Scene, simulate as simulate
    from .uv import bind as bind, make_atlas as make_atlas

# Loaded when first asked for: `import physxnet_jax` alone costs nothing.
_ROOMS = {
    "body": ("Body", "load_body"),
    "dressing": (
        "Character",
        "Clothed",
        "DressedClip",
        "Dresser",
        "clothe",
        "clothe_frame",
        "dress",
        "load_character",
        "make_dresser",
        "start_clothing",
        "with_shape",
    ),
    "errors": ("PhysXNetError",),
    "garment": ("Fabric", "Garment", "template"),
    "io": ("fit_garment", "inspect_garment", "load_garment", "load_predictor", "write_clip"),
    "models": ("Predictor", "dress_frames", "make_wearable", "pad_clip"),
    "motion": ("Motion", "inspect_motion", "load_motion"),
    "simulation": ("Scene", "simulate"),
    "uv": ("bind", "make_atlas"),
}
_HOME = {name: room for room, names in _ROOMS.items() for name in names}

__all__ = [
    "Body",
    "Character",
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
    "inspect_motion",
    "load_body",
    "load_character",
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
    "with_shape",
    "write_clip",
]


def __getattr__(name: str) -> object:
    """Loads the room that a public name lives in; rooms themselves as well."""
    if name in _HOME:
        value = getattr(_importlib.import_module(f".{_HOME[name]}", __name__), name)
        globals()[name] = value
        return value
    if not name.startswith("_"):
        try:
            return _importlib.import_module(f".{name}", __name__)
        except ModuleNotFoundError as error:
            if error.name != f"{__name__}.{name}":
                raise
    raise AttributeError(f"module '{__name__}' has no attribute '{name}'")


def __dir__() -> list[str]:
    """Public names, loaded or not."""
    return sorted({*__all__, *globals()})
