"""A garment over another: what is worn over it is kept outside."""

import dataclasses
from collections.abc import Sequence
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.spatial import KDTree

from ..body import NUM_BODY_VERTICES, Body
from ..garment import Garment
from ..geometry import (
    Smoothing,
    TriMesh,
    closest_among,
    each_frame,
    gaussian_smoothing,
    vertex_normals,
)
from ..models import Wearable
from ..typing import pytree
from ._push_out import least_height
from ._skirt import skin_foot

_Worn = TypeVar("_Worn", Garment, Wearable)

# Triangles compared for each vertex, and how far from it they may lie at rest [m].
_PATCH, _REACH = 24, 0.05
# Beyond a hem of what is beneath, what is over it comes down again within this [m].
_PAST_HEM = 0.03
# Nothing is lifted from deeper than this [m].
_DEEPEST = 0.06
# Lifts are averaged over this distance along the cloth, and taken in full at their own vertex [m].
_CARRY = 0.02


@pytree
@dataclasses.dataclass(frozen=True)
class Layer:
    """Where a garment lies over another.

    Attributes:
        rows: Vertices of the outer garment near the inner one, shape [rows].
        faces: Triangles of the inner garment that face outward, shape [faces, 3].
        candidates: Triangles of the inner garment near each row, shape [rows, k].
        least: Least height of each row above the inner garment [m], shape [rows].
        carry: Means over neighbourhoods of the outer garment.
        inner: Place of the inner garment among those worn.
        outer: Place of the outer one.
    """

    rows: Int[Array, " rows"]
    faces: Int[Array, "faces 3"]
    candidates: Int[Array, "rows k"]
    least: Float[Array, " rows"]
    carry: Smoothing
    inner: int = dataclasses.field(metadata={"static": True})
    outer: int = dataclasses.field(metadata={"static": True})


def inside_out(garments: Sequence[_Worn]) -> list[_Worn]:
    """Garments in the order of layers: trousers, dresses, tops; else as they come."""
    return sorted(garments, key=lambda g: ("bottom", "dress", "top").index(g.template))


def make_layers(
    body: Body,
    rest: Float[Array, "all 3"],
    wearables: Sequence[Wearable],
    garments: Sequence[Garment],
) -> tuple[Layer, ...]:
    """Which garment lies over which, in the order in which they are to be resolved.

    Trousers are innermost, then dresses, then tops; of two of one kind the one named
    first is beneath. Innermost trousers are pressed beneath a top by `tuck_in` and are no
    layer of it.

    Args:
        body: The body.
        rest: Its rest vertices [m].
        wearables: What is worn.
        garments: The same, with their meshes.
    """
    places = {id(w): k for k, w in enumerate(wearables)}
    order = [places[id(w)] for w in inside_out(wearables)]
    skin = np.asarray(rest)[:NUM_BODY_VERTICES]
    out = []
    for k, outer in enumerate(order):
        for inner in order[:k]:
            pair = (wearables[inner].template, wearables[outer].template)
            # Trousers over trousers were lifted off, out of where they were tucked in.
            if pair == ("bottom", "top") and all(layer.outer != inner for layer in out):
                continue
            layer = _make_layer(skin, wearables, garments, inner, outer)
            if layer is not None:
                out.append(layer)
    return tuple(out)


def _make_layer(
    skin: Float[np.ndarray, "skin 3"],
    wearables: Sequence[Wearable],
    garments: Sequence[Garment],
    inner: int,
    outer: int,
) -> Layer | None:
    below, above = (np.asarray(wearables[k].rest) for k in (inner, outer))
    faces = np.asarray(garments[inner].mesh.faces)
    middles = below[faces].mean(axis=1)
    k = min(_PATCH, len(faces))
    near = KDTree(middles).query(above, k=k)[1].reshape(len(above), k)
    # Middles of large triangles may be far away while they are near.
    mesh = TriMesh(jnp.asarray(below), jnp.asarray(faces))
    hit = jax.jit(closest_among)(mesh, jnp.asarray(above), jnp.asarray(near.astype(np.int32)))
    rows = np.flatnonzero(np.asarray(hit.squared_distance) < _REACH**2)
    if len(rows) == 0:
        return None
    # Some files have their faces inside out: outward is away from the skin.
    normals = np.asarray(vertex_normals(jnp.asarray(below), jnp.asarray(faces)))
    out = below - skin[KDTree(skin).query(below)[1]]
    if np.sum(normals * out) < 0.0:
        faces = faces[:, ::-1]
    own = np.asarray(garments[outer].mesh.faces)
    return Layer(
        jnp.asarray(rows.astype(np.int32)),
        jnp.asarray(np.ascontiguousarray(faces).astype(np.int32)),
        jnp.asarray(near[rows].astype(np.int32)),
        jnp.asarray(least_height(above, own)[rows]),
        gaussian_smoothing(above, own, _CARRY),
        inner,
        outer,
    )


def lift_off(
    layer: Layer, beneath: Float[Array, "inner 3"], points: Float[Array, "outer 3"]
) -> Float[Array, "outer 3"]:
    """The outer garment moved to its least height above the inner one.

    Vertices deeper than six centimetres are left alone, and so are those beside the inner
    garment: past its hem the lift fades out within three centimetres.

    Args:
        layer: Where it lies over the other.
        beneath: Vertices of the inner garment [m].
        points: Vertices of the outer one [m].
    """
    move = jnp.zeros_like(points).at[layer.rows].set(_way_up(layer, beneath, points))
    # Once smoothly, so that no vertex is pulled out of its neighbourhood, then exactly.
    points = points + layer.carry @ move
    return points.at[layer.rows].add(_way_up(layer, beneath, points))


def lift_layers(
    layers: Sequence[Layer], worn: Sequence[Float[Array, "frames _ 3"]]
) -> list[Float[Array, "frames _ 3"]]:
    """All garments of some frames, each off those beneath it."""
    out = list(worn)
    for layer in layers:

        def one(inner: Array, outer: Array, where: Layer = layer) -> Array:
            return lift_off(where, inner, outer)

        out[layer.outer] = each_frame(one, out[layer.inner], out[layer.outer])
    return out


def layer_height(
    layer: Layer, beneath: Float[Array, "inner 3"], points: Float[Array, "outer 3"]
) -> tuple[Float[Array, " rows"], Float[Array, " rows"], Float[Array, "rows 3"]]:
    """Heights above the inner garment, distances beside it [m], and its unit normals there."""
    normals = vertex_normals(beneath, layer.faces)
    mine = points[layer.rows]
    foot, normal = skin_foot(beneath, normals, layer.faces, mine, layer.candidates)
    height = jnp.sum((mine - foot) * normal, axis=1)
    beside = mine - foot - height[:, None] * normal
    squared = jnp.sum(beside * beside, axis=1)
    # The root has no derivative at zero, where nothing lies beside.
    safe = jnp.where(squared > 1e-12, squared, jnp.ones_like(squared))
    return height, jnp.where(squared > 1e-12, jnp.sqrt(safe), 0.0), normal


def _way_up(
    layer: Layer, beneath: Float[Array, "inner 3"], points: Float[Array, "outer 3"]
) -> Float[Array, "rows 3"]:
    height, beside, normal = layer_height(layer, beneath, points)
    fade = jnp.clip((height + _DEEPEST) / (0.25 * _DEEPEST), 0.0, 1.0)
    fade = fade * jnp.clip(1.0 - beside / _PAST_HEM, 0.0, 1.0)
    return (fade * jnp.maximum(layer.least - height, 0.0))[:, None] * normal
