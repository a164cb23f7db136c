"""Array type aliases shared by all packages.

Axis names are fixed: ``batch frames vertices faces joints height width channels``
(and ``texels``, the covered pixels of an atlas, in row-major order).
"""

import dataclasses
from typing import Any, TypeAlias, TypeVar

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped

Vertices: TypeAlias = Float[Array, "vertices 3"] | Float[np.ndarray, "vertices 3"]
"""Vertex positions [m], world frame, Y up."""

Animation: TypeAlias = Float[Array, "frames vertices 3"] | Float[np.ndarray, "frames vertices 3"]
"""Vertex positions [m] of every frame."""

Faces: TypeAlias = Int[Array, "faces 3"] | Int[np.ndarray, "faces 3"]
"""Triangles as indices into vertices, counter-clockwise seen from outside."""

Points: TypeAlias = Float[Array, "points 3"] | Float[np.ndarray, "points 3"]
Texels: TypeAlias = Float[Array, "texels channels"]
Maps: TypeAlias = Float[Array, "*batch height width channels"]
Mask: TypeAlias = Bool[Array, "height width"] | Bool[np.ndarray, "height width"]
Quaternions: TypeAlias = Float[Array, "*batch 4"] | Float[np.ndarray, "*batch 4"]
"""Unit quaternions, wxyz."""

AnyArray: TypeAlias = Shaped[Array, "..."] | Shaped[np.ndarray, "..."]

_Class = TypeVar("_Class", bound=type)


def _short_repr(instance: Any) -> str:
    """Fields with arrays as their type and shape, such as ``rest=f32[2726,3]``."""
    fields = dataclasses.fields(instance)
    shown = (f"{f.name}={_short(getattr(instance, f.name))}" for f in fields if f.repr)
    return f"{type(instance).__name__}({', '.join(shown)})"


def _short(value: Any) -> str:
    if isinstance(value, jax.Array | np.ndarray):
        kind = value.dtype.kind.replace("b", "bool").replace("V", "key")
        bits = "" if kind in ("bool", "key", "O") else str(8 * value.dtype.itemsize)
        return f"{kind}{bits}[{','.join(map(str, value.shape))}]"
    if isinstance(value, tuple | list) and len(value) > 4:
        return f"{type(value).__name__} of {len(value)}"
    if isinstance(value, tuple | list):
        return f"({', '.join(map(_short, value))}{',' if len(value) == 1 else ''})"
    if isinstance(value, dict):
        return f"{{{', '.join(f'{k}: {_short(v)}' for k, v in value.items())}}}"
    text = repr(value)
    return text if len(text) <= 200 else f"{type(value).__name__}(...)"


def pytree(cls: _Class) -> _Class:
    """Registers a frozen dataclass as a pytree.

    JAX rebuilds pytrees around batched arrays, shapes and placeholder objects. Field
    annotations describe a single instance, so they aren't checked at run time.

    Args:
        cls: A frozen dataclass. Fields with metadata ``static=True`` aren't leaves. Fields
            with metadata ``drop=True`` aren't part of the pytree: they inform the user, and
            instances that JAX rebuilds have the default values.

    Returns:
        The class.
    """
    cls.__no_type_check__ = True  # pyright: ignore[reportAttributeAccessIssue]
    # Generated methods would print whole arrays, and compare them where a bool is expected.
    parameters = cls.__dataclass_params__  # pyright: ignore[reportAttributeAccessIssue]
    if parameters.eq:
        setattr(cls, "__eq__", object.__eq__)  # noqa: B010
        setattr(cls, "__hash__", object.__hash__)  # noqa: B010
    if parameters.repr:
        setattr(cls, "__repr__", _short_repr)  # noqa: B010
    dropped = [f.name for f in dataclasses.fields(cls) if f.metadata.get("drop", False)]  # pyright: ignore[reportArgumentType]
    kept = [f for f in dataclasses.fields(cls) if f.name not in dropped]  # pyright: ignore[reportArgumentType]
    static = [f.name for f in kept if f.metadata.get("static", False)]
    leaves = [f.name for f in kept if f.name not in static]
    return jax.tree_util.register_dataclass(cls, leaves, static, dropped)


__all__ = [
    "Animation",
    "AnyArray",
    "Faces",
    "Maps",
    "Mask",
    "Points",
    "Quaternions",
    "Texels",
    "Vertices",
    "pytree",
]
