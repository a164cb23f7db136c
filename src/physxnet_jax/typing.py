"""The shape vocabulary: array aliases shared by every room.

Axis names are fixed: ``batch frames vertices faces joints height width channels``
(and ``texels``, the covered pixels of an atlas, in row-major order).
"""

from typing import TypeAlias

import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped

Vertices: TypeAlias = Float[Array, "vertices 3"] | Float[np.ndarray, "vertices 3"]
"""Vertex positions [m], world frame, Y up."""

Animation: TypeAlias = (
    Float[Array, "frames vertices 3"] | Float[np.ndarray, "frames vertices 3"]
)
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
]
