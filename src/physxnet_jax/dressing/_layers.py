"""A garment over another: what is worn over it is kept outside, what is beneath it inside."""

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

# Triangles compared for each vertex (half as many from beneath), and how far from it they may
# lie at rest [m].
_PATCH, _REACH = 24, 0.05
# Beyond a hem of what is beneath, what is over it comes down again within this [m].
_PAST_HEM = 0.03
# Nothing is lifted from deeper than this [m].
_DEEPEST = 0.06
# What is beneath is kept this far beneath triangles of what is over it [m].
_UNDER = 0.002
# Lifts are averaged over this distance along the cloth, and taken in full at their own vertex [m].
_CARRY = 0.02


@pytree
@dataclasses.dataclass(frozen=True)
class Layer:
    """On which side of another garment a garment is kept.

    Attributes:
        rows: Vertices of the garment that is moved, near the one that stays, shape [rows].
        faces: Triangles of the one that stays, facing the side to be kept to: outward
            where what is over it is lifted off, inward where what is beneath it is
            pressed under. Shape [faces, 3].
        candidates: Those of them near each row, shape [rows, k].
        least: Least height of each row on that side [m], shape [rows].
        carry: Means over neighbourhoods of the garment that is moved; None where it is
            pressed under.
        still: Place of the garment that stays among those worn.
        moved: Place of the one that is moved.
    """

    rows: Int[Array, " rows"]
    faces: Int[Array, "faces 3"]
    candidates: Int[Array, "rows k"]
    least: Float[Array, " rows"]
    carry: Smoothing | None
    still: int = dataclasses.field(metadata={"static": True})
    moved: int = dataclasses.field(metadata={"static": True})


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
    first is beneath. The outer garment is lifted off the inner one; where a vertex of the
    inner one still comes through a triangle of it, that vertex is then pressed under.
    Innermost trousers are pressed beneath a top by `tuck_in` and are no layer of it.

    Args:
        body: The body.
        rest: Its rest vertices [m].
        wearables: What is worn.
        garments: The same, with their meshes.
    """
    places = {id(w): k for k, w in enumerate(wearables)}
    order = [places[id(w)] for w in inside_out(wearables)]
    skin = np.asarray(rest)[:NUM_BODY_VERTICES]
    faces = [_facing_outward(skin, w, g) for w, g in zip(wearables, garments, strict=True)]
    out = []
    lifted = set()
    for k, outer in enumerate(order):
        for inner in order[:k]:
            pair = (wearables[inner].template, wearables[outer].template)
            # Trousers over trousers were lifted off, out of where they were tucked in.
            if pair == ("bottom", "top") and inner not in lifted:
                continue
            lift = _make_layer(wearables, faces, inner, outer)
            press = _make_layer(wearables, faces, outer, inner, under=True)
            if len(lift.rows):
                lifted.add(outer)
                out.append(lift)
            if len(press.rows):
                out.append(press)
    return tuple(out)


def _facing_outward(
    skin: Float[np.ndarray, "skin 3"], wearable: Wearable, garment: Garment
) -> Int[np.ndarray, "faces 3"]:
    """Triangles of a garment; some files have theirs inside out."""
    points, faces = np.asarray(wearable.rest), np.asarray(garment.mesh.faces)
    normals = np.asarray(vertex_normals(jnp.asarray(points), jnp.asarray(faces)))
    out = points - skin[KDTree(skin).query(points)[1]]
    return faces[:, ::-1] if np.sum(normals * out) < 0.0 else faces


def _make_layer(
    wearables: Sequence[Wearable],
    outward: Sequence[Int[np.ndarray, "_ 3"]],
    still: int,
    moved: int,
    under: bool = False,
) -> Layer:
    other, points = (np.asarray(wearables[k].rest) for k in (still, moved))
    faces = outward[still][:, ::-1] if under else outward[still]
    k = min(_PATCH // 2 if under else _PATCH, len(faces))
    near = KDTree(other[faces].mean(axis=1)).query(points, k=k)[1].reshape(len(points), k)
    # Middles of large triangles may be far away while they are near.
    mesh = TriMesh(jnp.asarray(other), jnp.asarray(faces))
    hit = jax.jit(closest_among)(mesh, jnp.asarray(points), jnp.asarray(near.astype(np.int32)))
    rows = np.flatnonzero(np.asarray(hit.squared_distance) < _REACH**2)
    least = (
        np.full(len(points), _UNDER, np.float32) if under else least_height(points, outward[moved])
    )
    return Layer(
        jnp.asarray(rows.astype(np.int32)),
        jnp.asarray(np.ascontiguousarray(faces).astype(np.int32)),
        jnp.asarray(near[rows].astype(np.int32)),
        jnp.asarray(least[rows]),
        # What is hidden needn't be smooth.
        None if under else gaussian_smoothing(points, outward[moved], _CARRY),
        still,
        moved,
    )


def keep_apart(
    layer: Layer, other: Float[Array, "still 3"], points: Float[Array, "moved 3"]
) -> Float[Array, "moved 3"]:
    """A garment moved to its least height on its side of another.

    Vertices six centimetres on the wrong side are left alone, and so are those beside the
    other garment: past its hem the way fades out within three centimetres.

    Args:
        layer: On which side of the other it is kept.
        other: Vertices of the garment that stays [m].
        points: Vertices of the one that is moved [m].
    """
    move = jnp.zeros_like(points).at[layer.rows].set(_way_up(layer, other, points))
    # Once smoothly, so that no vertex is pulled out of its neighbourhood, then exactly. From
    # where it came to another triangle may be nearest.
    points = points + (move if layer.carry is None else layer.carry @ move)
    return points.at[layer.rows].add(_way_up(layer, other, points))


def keep_layers_apart(
    layers: Sequence[Layer], worn: Sequence[Float[Array, "frames _ 3"]]
) -> list[Float[Array, "frames _ 3"]]:
    """All garments of some frames, each on its side of the others."""
    out = list(worn)
    for layer in layers:

        def one(other: Array, points: Array, where: Layer = layer) -> Array:
            return keep_apart(where, other, points)

        out[layer.moved] = each_frame(one, out[layer.still], out[layer.moved])
    return out


def layer_height(
    layer: Layer, other: Float[Array, "still 3"], points: Float[Array, "moved 3"]
) -> tuple[Float[Array, " rows"], Float[Array, " rows"], Float[Array, "rows 3"]]:
    """Heights above the other garment, distances beside it [m], and its unit normals there."""
    normals = vertex_normals(other, layer.faces)
    mine = points[layer.rows]
    foot, normal = skin_foot(other, normals, layer.faces, mine, layer.candidates)
    height = jnp.sum((mine - foot) * normal, axis=1)
    beside = mine - foot - height[:, None] * normal
    squared = jnp.sum(beside * beside, axis=1)
    # The root has no derivative at zero, where nothing lies beside.
    safe = jnp.where(squared > 1e-12, squared, jnp.ones_like(squared))
    return height, jnp.where(squared > 1e-12, jnp.sqrt(safe), 0.0), normal


def _way_up(
    layer: Layer, other: Float[Array, "still 3"], points: Float[Array, "moved 3"]
) -> Float[Array, "rows 3"]:
    height, beside, normal = layer_height(layer, other, points)
    fade = jnp.clip((height + _DEEPEST) / (0.25 * _DEEPEST), 0.0, 1.0)
    fade = fade * jnp.clip(1.0 - beside / _PAST_HEM, 0.0, 1.0)
    return (fade * jnp.maximum(layer.least - height, 0.0))[:, None] * normal
