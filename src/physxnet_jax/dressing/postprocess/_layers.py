"""Layers: keeps outer garments outside of inner ones."""

import dataclasses
from collections.abc import Sequence
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.spatial import KDTree

from ...body import NUM_BODY_VERTICES
from ...garment import Garment, SkinnedGarment
from ...geometry import (
    Smoothing,
    closest_on_host,
    gaussian_smoothing,
    map_frames,
    vertex_normals,
)
from ...typing import pytree
from .._inference import Inference
from ._collisions import minimum_clearance
from ._outfit import Cloth, Outfit
from ._skirt import closest_skin_point

_Worn = TypeVar("_Worn", Garment, SkinnedGarment)

# Triangles compared for each vertex (half as many to press it under), and their maximum
# distance at rest [m].
_NUM_CANDIDATES, _MAX_DISTANCE = 24, 0.05
# Past the hem of the inner garment, displacements fade out over this distance [m].
_HEM_FADE = 0.03
# Deeper vertices aren't moved [m].
_MAX_DEPTH = 0.06
# Clearance of an inner garment below triangles of the outer one [m].
_PRESS_CLEARANCE = 0.002
# Width over which displacements are smoothed along the cloth, before the exact step [m].
_SMOOTHING_WIDTH = 0.02


@pytree
@dataclasses.dataclass(frozen=True)
class Layer:
    """Constraint that keeps one garment on one side of another.

    Attributes:
        rows: Vertices of the moved garment near the fixed one, shape [rows].
        faces: Triangles of the fixed garment, oriented towards the required side: outward
            where an outer garment is lifted off it, inward where an inner one is pressed
            under it. Shape [faces, 3].
        candidates: Indices of the triangles near each row, shape [rows, k].
        least: Minimum height of each row on that side [m], shape [rows].
        carry: Smoothing over the moved garment; None where it is pressed under.
        still: Index of the fixed garment among those worn.
        moved: Index of the moved garment.
    """

    rows: Int[Array, " rows"]
    faces: Int[Array, "faces 3"]
    candidates: Int[Array, "rows k"]
    least: Float[Array, " rows"]
    carry: Smoothing | None
    still: int = dataclasses.field(metadata={"static": True})
    moved: int = dataclasses.field(metadata={"static": True})


def layer_order(garments: Sequence[_Worn]) -> list[_Worn]:
    """Sorts garments into layer order: trousers, dresses, tops; stable within a type."""
    return sorted(garments, key=lambda g: ("bottom", "dress", "top").index(g.template))


def prepare_layers(outfit: Outfit, inference: Inference) -> tuple[Layer, ...] | None:
    """Lists the layers between garments, in the order in which they are resolved.

    Trousers are innermost, then dresses, then tops; of garments of one type later ones are
    outer. The outer garment is lifted off the inner one. Vertices of the inner garment that
    still penetrate its triangles are then pressed under. Innermost trousers form no layer
    with a top, because `prepare_collisions` keeps them beneath it.

    Args:
        outfit: The garments.
        inference: Its ``collisions`` enable the step.
    """
    if not inference.collisions:
        return None
    worn, garments = outfit.worn, outfit.garments
    places = {id(w): k for k, w in enumerate(worn)}
    order = [places[id(w)] for w in layer_order(worn)]
    skin = np.asarray(outfit.rest)[:NUM_BODY_VERTICES]
    faces = [_outward_faces(skin, w, g) for w, g in zip(worn, garments, strict=True)]
    out = []
    lifted = set()
    for k, outer in enumerate(order):
        for inner in order[:k]:
            pair = (worn[inner].template, worn[outer].template)
            # Trousers lifted off other trousers have left the heights that colliders set.
            if pair == ("bottom", "top") and inner not in lifted:
                continue
            lift = _make_layer(worn, faces, inner, outer)
            press = _make_layer(worn, faces, outer, inner, under=True)
            if len(lift.rows):
                lifted.add(outer)
                out.append(lift)
            if len(press.rows):
                out.append(press)
    return tuple(out)


def _outward_faces(
    skin: Float[np.ndarray, "skin 3"], worn: SkinnedGarment, garment: Garment
) -> Int[np.ndarray, "faces 3"]:
    """Triangles of a garment, oriented outward; in some files they face inward."""
    faces = np.asarray(garment.mesh.faces)
    a, b, c = np.moveaxis(np.asarray(worn.rest)[faces], 1, 0)
    middles = (a + b + c) / 3.0
    out = middles - skin[KDTree(skin).query(middles)[1]]
    return faces[:, ::-1] if np.sum(np.cross(b - a, c - a) * out) < 0.0 else faces


def _make_layer(
    worn: Sequence[SkinnedGarment],
    outward: Sequence[Int[np.ndarray, "_ 3"]],
    still: int,
    moved: int,
    under: bool = False,
) -> Layer:
    other, points = (np.asarray(worn[k].rest) for k in (still, moved))
    faces = outward[still][:, ::-1] if under else outward[still]
    k = min(_NUM_CANDIDATES // 2 if under else _NUM_CANDIDATES, len(faces))
    near = KDTree(other[faces].mean(axis=1)).query(points, k=k)[1].reshape(len(points), k)
    # A large triangle may be near although its centroid is far away.
    squared = closest_on_host(other, faces, points, near)[2]
    rows = np.flatnonzero(squared < _MAX_DISTANCE**2)
    least = (
        np.full(len(points), _PRESS_CLEARANCE, np.float32)
        if under
        else minimum_clearance(points, outward[moved])
    )
    return Layer(
        jax.device_put(rows.astype(np.int32)),
        jax.device_put(np.ascontiguousarray(faces).astype(np.int32)),
        jax.device_put(near[rows].astype(np.int32)),
        jax.device_put(least[rows]),
        # Hidden cloth needn't be smooth.
        None if under else gaussian_smoothing(points, outward[moved], _SMOOTHING_WIDTH),
        still,
        moved,
    )


def resolve_layer(
    layer: Layer, other: Float[Array, "still 3"], points: Float[Array, "moved 3"]
) -> Float[Array, "moved 3"]:
    """Moves a garment to its minimum height on its side of another.

    Vertices more than six centimetres on the wrong side aren't moved. Past the hem of the
    other garment, displacements fade out within three centimetres.

    Args:
        layer: The constraint.
        other: Vertices of the fixed garment [m].
        points: Vertices of the moved garment [m].
    """
    move = jnp.zeros_like(points).at[layer.rows].set(_correction(layer, other, points))
    # A smoothed step keeps vertices in their neighbourhood. The second step is exact; it searches
    # again because another triangle may now be the nearest.
    points = points + (move if layer.carry is None else layer.carry @ move)
    return points.at[layer.rows].add(_correction(layer, other, points))


def apply_layers(
    layers: Sequence[Layer],
    cloth: Cloth,
    rotations: Float[Array, "frames joints 3 3"],
    translations: Float[Array, "frames joints 3"],
) -> Cloth:
    """Keeps all garments on their sides of each other, frame by frame [m]."""
    del rotations, translations
    return resolve_layers(layers, cloth)


def resolve_layers(layers: Sequence[Layer], cloth: Cloth) -> Cloth:
    """`apply_layers` without a pose, which layers don't need."""
    out = list(cloth)
    for layer in layers:

        def one(other: Array, points: Array, where: Layer = layer) -> Array:
            return resolve_layer(where, other, points)

        out[layer.moved] = map_frames(one, out[layer.still], out[layer.moved])
    return tuple(out)


def layer_height(
    layer: Layer, other: Float[Array, "still 3"], points: Float[Array, "moved 3"]
) -> tuple[Float[Array, " rows"], Float[Array, " rows"], Float[Array, "rows 3"]]:
    """Heights above the other garment [m], lateral distances from it [m] and its unit normals."""
    normals = vertex_normals(other, layer.faces)
    queries = points[layer.rows]
    closest, normal = closest_skin_point(other, normals, layer.faces, queries, layer.candidates)
    height = jnp.sum((queries - closest) * normal, axis=1)
    lateral = queries - closest - height[:, None] * normal
    squared = jnp.sum(lateral * lateral, axis=1)
    # The square root has no derivative at zero.
    safe = jnp.where(squared > 1e-12, squared, jnp.ones_like(squared))
    return height, jnp.where(squared > 1e-12, jnp.sqrt(safe), 0.0), normal


def _correction(
    layer: Layer, other: Float[Array, "still 3"], points: Float[Array, "moved 3"]
) -> Float[Array, "rows 3"]:
    height, lateral, normal = layer_height(layer, other, points)
    fade = jnp.clip((height + _MAX_DEPTH) / (0.25 * _MAX_DEPTH), 0.0, 1.0)
    fade = fade * jnp.clip(1.0 - lateral / _HEM_FADE, 0.0, 1.0)
    return (fade * jnp.maximum(layer.least - height, 0.0))[:, None] * normal
