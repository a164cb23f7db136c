"""Cuts garments to measure."""

import dataclasses
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...body import Body, load_body
from ...errors import PhysXNetError
from ...geometry import make_mesh
from .._fabric import find_fabric
from .._garment import Fabric, Garment, Template
from ._charts import load_charts, place_table
from ._cut import class_of, cut, pattern_of, resolve_measures, stored_cut
from ._flatten import flatten
from ._grid import spline
from ._measures import MEASURES, kind_of
from ._pattern import Pattern

_TEMPLATES: dict[str, Template] = {"top": "top", "strapless": "top", "trousers": "bottom"}
# Space between the panels of a pattern [m].
_APART = 0.05
_LEAST_THICKNESS = 0.005


def tailor(
    kind: str,
    *,
    ease: float | None = None,
    length: float | None = None,
    flare: float | None = None,
    sleeve: float | None = None,
    neckline: float | None = None,
    fabric: str | None = None,
    hold: tuple[str, ...] = (),
    body: Body | None = None,
    shape: Float[Array, " shapes"] | None = None,
) -> Garment:
    """Cuts a garment to measure.

    Args:
        kind: One of `KINDS`.
        ease: Circumference of the garment minus the body's [m]: of the chest for tops and
            dresses, of the hip for skirts, of the thigh for trousers.
        length: From the shoulder (tops, dresses), the upper border (strapless) or the waist
            (skirts, trousers) straight down to the hem [m].
        flare: What the hem is wider than without flare [m], around the body or around a leg.
        sleeve: From the shoulder along the arm to the cuff [m].
        neckline: Depth of the neckline in front, below its beginning at the shoulder [m].
        fabric: Name of a fabric; the kind's own if None.
        hold: Curves that are fixed to the body, of ``waist``, ``top``, ``neckline``, ``hem``,
            ``cuff left`` and ``cuff right``. Waists and upper borders have an elastic band, which
            holds them up unless they are fixed.
        body: The body that it is cut for; the built-in one if None.
        shape: Shape parameters of that body; the default if None.

    Returns:
        The garment at rest on the body's default shape, with a pattern in metres as texture
        coordinates. Measures that aren't given are the kind's own; `KINDS` has their ranges.

    Raises:
        PhysXNetError: No such kind, measure, fabric or curve, or a measure out of range.

    Example:
        >>> tailor("tee", ease=0.1, length=0.55).template
        'top'
    """
    style = kind_of(kind)
    body = load_body() if body is None else body
    shape = body.default_shape() if shape is None else shape
    given = (ease, length, flare, sleeve, neckline)
    measures = resolve_measures(kind, dict(zip(map(str, MEASURES), given)))
    pattern = pattern_of(kind, class_of(style, measures))
    for name in hold:
        if name not in pattern.loops:
            raise PhysXNetError(f"{kind} has no {name} to hold; it has {', '.join(pattern.loops)}.")
    rest = body.rest_vertices(shape)
    stored = stored_cut(kind, measures, rest)
    vertices, places = cut(kind, pattern, measures, rest) if stored is None else stored
    refs, weights, skin = _attachment(pattern, places, body)
    offset = vertices - jnp.sum(rest[refs] * weights[..., None], axis=1)
    uv, uv_faces = _pattern_places(pattern, np.asarray(vertices, np.float64))
    usual = body.rest_vertices(body.default_shape())
    worn = jnp.sum(usual[refs] * weights[..., None], axis=1) + offset
    pinned = np.zeros(pattern.num_vertices, dtype=bool)
    for name in hold:
        pinned[pattern.loops[name]] = True
    return Garment(
        make_mesh(worn, pattern.faces, uv, uv_faces, name=kind),
        jax.device_put(pinned),
        refs,
        weights,
        offset,
        skin,
        _fabric(fabric or style.fabric),
        _TEMPLATES.get(style.style, "dress"),
        kind,
        loops={k: jax.device_put(e.astype(np.int32)) for k, e in pattern.loops.items()},
        elastic=tuple(name for name in style.elastic if name not in hold),
    )


def _fabric(name: str) -> Fabric:
    cloth = find_fabric(name)
    return dataclasses.replace(cloth, thickness=max(cloth.thickness, _LEAST_THICKNESS))


def _attachment(
    pattern: Pattern, places: Mapping[str, Array], body: Body
) -> tuple[Array, Array, Array]:
    """Vertices of the body that each vertex is attached to, their weights, skinning weights."""
    charts, n = load_charts(), pattern.num_vertices
    refs = np.zeros((n, 12), np.int32)
    weights = np.zeros((n, 12), np.float32)
    skin = np.zeros((n, body.weights.shape[1]), np.float64)
    own = np.asarray(body.weights, np.float64)
    start = 0
    for name, panel in pattern.panels.items():
        chart = charts.chart(panel.chart)
        uv = np.asarray(places[name], np.float64)
        index, share = spline(chart.origin, uv, chart.fields.shape[:2])
        nearest = index[np.arange(len(uv)), np.argmax(share, axis=1)]
        for half in (False, True):
            owner = pattern.owner[start : start + len(uv)]
            table_refs, table_weights = place_table(panel.chart, half)
            refs[owner], weights[owner] = 0, 0.0
            k = table_refs.shape[1]
            refs[owner, :k], weights[owner, :k] = table_refs[nearest], table_weights[nearest]
            node = np.einsum("nk,nkj->nj", table_weights, own[table_refs])
            np.add.at(skin, owner, np.einsum("ns,nsj->nj", share, node[index]))
            start += len(uv)
    skin = np.maximum(skin, 0.0)
    skin /= skin.sum(axis=1, keepdims=True)
    return jax.device_put(refs), jax.device_put(weights), jax.device_put(skin.astype(np.float32))


def _pattern_places(
    pattern: Pattern, vertices: Float[np.ndarray, "vertices 3"]
) -> tuple[np.ndarray, np.ndarray]:
    """Texture coordinates in metres: each panel flattened as cut, beside the one before it."""
    places, corners, start, count, x = [], [], 0, 0, 0.0
    for panel in pattern.panels.values():
        n = len(panel.middle)
        flat = flatten(
            vertices[pattern.owner[start : start + n]],
            panel.faces,
            panel.pattern,
            on_axis=panel.axis,
            steps=40,
        )
        # Halves that are one piece meet in the middle; others lie side by side.
        inner = 0.0 if panel.axis is not None else flat[:, 0].min() - 0.5 * _APART
        flat = flat - [inner, flat[:, 1].min()]
        width = flat[:, 0].max()
        for half in (False, True):
            sign = 1.0 if panel.outward != half else -1.0
            places.append(flat * [sign, 1.0] + [x + width, 0.0])
            tri = panel.faces + count
            corners.append(tri if panel.outward != half else tri[:, [0, 2, 1]])
            count += n
            start += n
        x += 2 * width + _APART
    return np.concatenate(places), np.concatenate(corners)
