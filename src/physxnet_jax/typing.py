"""The shape vocabulary: array aliases shared by every room.

Axis names are fixed: ``batch frames vertices faces joints height width channels``
(and ``texels``, the covered pixels of an atlas, in row-major order).
"""

import dataclasses
from typing import TypeAlias, TypeVar

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


def pytree(cls: _Class) -> _Class:
    """Registers a frozen dataclass as a pytree.

    JAX rebuilds pytrees around whatever it maps over: batched arrays, shapes, mere
    markers. Their fields' annotations tell the shape of one instance and aren't checked.

    Args:
        cls: A frozen dataclass; fields with metadata ``static=True`` aren't leaves. Those
            with ``told=True`` aren't part of the pytree at all: they are for people, and
            have their default again in whatever JAX rebuilds.

    Returns:
        The class.
    """
    cls.__no_type_check__ = True  # pyright: ignore[reportAttributeAccessIssue]
    told = [f.name for f in dataclasses.fields(cls) if f.metadata.get("told", False)]  # pyright: ignore[reportArgumentType]
    kept = [f for f in dataclasses.fields(cls) if f.name not in told]  # pyright: ignore[reportArgumentType]
    static = [f.name for f in kept if f.metadata.get("static", False)]
    leaves = [f.name for f in kept if f.name not in static]
    return jax.tree_util.register_dataclass(cls, leaves, static, told)


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
