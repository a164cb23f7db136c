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
    compile_whole_programs as _compile_whole_programs,
    enable_compilation_cache as _enable_compilation_cache,
    is_command as _is_command,
    share_one_heap as _share_one_heap,
    uses_compilation_cache as _uses_compilation_cache,
    uses_few_parts as _uses_few_parts,
)
from ._version import __version__ as __version__

# A command is its own process; a program that imports this package decides for itself.
if _uses_compilation_cache(_sys.argv):
    _enable_compilation_cache()
if _is_command(_sys.argv):
    _share_one_heap()
if _uses_few_parts(_sys.argv):
    _compile_whole_programs()

# `physxnet doctor` must be able to report what is wrong.
if not (_is_command(_sys.argv) and _sys.argv[1:2] == ["doctor"]):
    _check_jaxlib()

if _TYPE_CHECKING:
    from .body import Body as Body, load_body as load_body
    from .dressing import (
        AdaptConfig as AdaptConfig,
        Adapted as Adapted,
        Character as Character,
        Clothed as Clothed,
        DressedClip as DressedClip,
        Dresser as Dresser,
        Inference as Inference,
        Simulation as Simulation,
        adapt as adapt,
        clothe as clothe,
        clothe_step as clothe_step,
        dress as dress,
        fit_garment as fit_garment,
        init_stream as init_stream,
        inspect_character as inspect_character,
        inspect_garment as inspect_garment,
        load_character as load_character,
        make_dresser as make_dresser,
        pad_frames as pad_frames,
        with_cut as with_cut,
        with_fabric as with_fabric,
        with_shape as with_shape,
        write_dressed_character as write_dressed_character,
    )
    from .errors import PhysXNetError as PhysXNetError
    from .garment import (
        Fabric as Fabric,
        Garment as Garment,
        load_garment as load_garment,
        tailor as tailor,
        template as template,
    )
    from .io import write_clip as write_clip
    from .models import (
        Predictor as Predictor,
        bind_garment as bind_garment,
        dress_frames as dress_frames,
        load_predictor as load_predictor,
        pad_clip as pad_clip,
    )
    from .motion import (
        Motion as Motion,
        inspect_motion as inspect_motion,
        load_motion as load_motion,
    )
    from .simulation import Scene as Scene, simulate as simulate
    from .uv import (
        bind as bind,
        body_maps as body_maps,
        garment_map as garment_map,
        make_atlas as make_atlas,
        transference as transference,
    )

# Loaded on first use: `import physxnet_jax` alone costs nothing.
_PACKAGES = {
    "body": (
        "Body",
        "load_body",
    ),
    "dressing": (
        "AdaptConfig",
        "Adapted",
        "Character",
        "Clothed",
        "DressedClip",
        "Dresser",
        "Inference",
        "Simulation",
        "adapt",
        "clothe",
        "clothe_step",
        "dress",
        "fit_garment",
        "init_stream",
        "inspect_character",
        "inspect_garment",
        "load_character",
        "write_dressed_character",
        "make_dresser",
        "pad_frames",
        "with_cut",
        "with_fabric",
        "with_shape",
    ),
    "errors": ("PhysXNetError",),
    "garment": (
        "Fabric",
        "Garment",
        "load_garment",
        "tailor",
        "template",
    ),
    "io": ("write_clip",),
    "models": (
        "Predictor",
        "bind_garment",
        "dress_frames",
        "load_predictor",
        "pad_clip",
    ),
    "motion": (
        "Motion",
        "inspect_motion",
        "load_motion",
    ),
    "simulation": (
        "Scene",
        "simulate",
    ),
    "uv": (
        "bind",
        "body_maps",
        "garment_map",
        "make_atlas",
        "transference",
    ),
}
_HOME = {name: package for package, names in _PACKAGES.items() for name in names}

__all__ = [
    "AdaptConfig",
    "Adapted",
    "Body",
    "Character",
    "Clothed",
    "DressedClip",
    "Dresser",
    "Fabric",
    "Garment",
    "Inference",
    "Motion",
    "PhysXNetError",
    "Predictor",
    "Scene",
    "Simulation",
    "__version__",
    "adapt",
    "bind",
    "bind_garment",
    "body_maps",
    "clothe",
    "clothe_step",
    "dress",
    "dress_frames",
    "fit_garment",
    "garment_map",
    "init_stream",
    "inspect_character",
    "inspect_garment",
    "inspect_motion",
    "load_body",
    "load_character",
    "write_dressed_character",
    "load_garment",
    "load_motion",
    "load_predictor",
    "make_atlas",
    "make_dresser",
    "pad_clip",
    "pad_frames",
    "simulate",
    "tailor",
    "template",
    "transference",
    "with_cut",
    "with_fabric",
    "with_shape",
    "write_clip",
]


def __getattr__(name: str) -> object:
    """Imports the package that a public name lives in; packages themselves as well."""
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
