"""The surface of a garment: how far it stands off the body, for given measures."""

import dataclasses
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._charts import ARM, FREE, HEIGHT, REACH, Carrier, ChartName, Charts
from ._curves import rings
from ._grid import spline
from ._measures import Kind

# Cloth takes at most this share of the distance at which it would meet that of the next limb.
_ROOM = 0.8
# A garment fades from the chest's width to the shoulders' between these heights [m].
_FADE = (0.37, 0.50)
# Trunk and legs are blended between these heights [m].
_CROTCH = (-0.14, -0.06)
# How much tighter than the clearance cloth may lie: half of it around the body [m].
_TIGHT = -0.025
# How round the positive part of a length is [m].
_SMOOTH = 0.002
# Two lengths are blended by a maximum that is this round [m].
_ROUND = 0.01
WAIST = {"trousers": 0.10, "skirt": 0.16, "dress": 0.20, "strapless-dress": 0.20}
"""Height of the waist on the default shape [m]."""
# Ease of a waist that elastic or a dart holds [m].
_WAIST_EASE = {"trousers": 0.012, "skirt": 0.012, "dress": 0.05, "strapless-dress": 0.05}
# What the bare carrier is wider than the skin that a tape measures [m].
_SNUG = 0.05
_ANKLE = -0.73
# A ring's length grows by 2 pi times what it is moved outwards, but for its hollows: a few steps.
STEPS = 10


@dataclasses.dataclass(frozen=True, eq=False)
class Form:
    """A garment's surface on one body.

    Attributes:
        carrier: The body's smooth surface.
        off: How far cloth stands off it at each ring of trunk, legs, arms and skirt [m].
    """

    carrier: Carrier
    off: Mapping[str, Float[Array, " rings"]]


def place(
    form: Form, charts: Charts, name: ChartName, uv: Float[Array, "points 2"]
) -> tuple[Float[Array, "points 3"], Float[Array, "points 3"]]:
    """Points of the garment at places of a chart [m], on the left and on the right."""
    chart = charts.chart(name)
    index, share = spline(chart.origin.astype(np.float32), uv, chart.fields.shape[:2])
    weight = jax.device_put(share)
    table = jax.device_put(chart.fields.reshape(-1, 4))
    fields = jnp.sum(table[index] * weight[..., None], axis=1)
    left, right = (
        _stand(form, name == "skirt", index + charts.start(name, side), weight, fields)
        for side in (False, True)
    )
    return _on_its_side(left, 1.0), _on_its_side(right, -1.0)


def _on_its_side(points: Float[Array, "points 3"], sign: float) -> Float[Array, "points 3"]:
    """Keeps points of one half from crossing the middle."""
    return points.at[:, 0].set(sign * _above_zero(sign * points[:, 0]))


def _above_zero(x: Array) -> Array:
    """A smooth, positive approximation of the positive part of lengths."""
    return 0.5 * (x + jnp.sqrt(x**2 + _SMOOTH**2))


def ring_points(form: Form, part: str) -> Float[Array, "rings pieces points 3"]:
    """Points of the garment's rings around a part [m]."""
    table = rings(part)
    flat = (x.reshape(-1, x.shape[-1]) for x in (table.nodes, table.weights, table.fields))
    return _stand(form, table.skirt, *map(jax.device_put, flat)).reshape(*table.nodes.shape[:3], 3)


def _stand(form: Form, skirt: bool, nodes: Array, weights: Array, fields: Array) -> Array:
    """Points that stand off the carrier."""
    values = jnp.sum(form.carrier[nodes] * weights[..., None], axis=1)
    n = values[:, 3:6]
    n = n / jnp.linalg.norm(n, axis=1, keepdims=True)
    off = _off(form, skirt, fields)
    clear = values[:, 6]
    room = _above_zero(_ROOM * fields[:, FREE] - clear)
    off = room * jnp.tanh(off / room)
    return values[:, :3] + (clear + off)[:, None] * n


def _off(form: Form, skirt: bool, fields: Float[Array, "points 4"]) -> Float[Array, " points"]:
    height = fields[:, HEIGHT]
    if skirt:
        return jnp.interp(height, rings("skirt").levels, form.off["skirt"])
    trunk = jnp.interp(height, rings("torso").levels, form.off["torso"])
    trunk = trunk * (1 - _smoothstep(height, *_FADE))
    leg = jnp.interp(height, rings("leg").levels, form.off["leg"])
    upper = _smoothstep(height, *_CROTCH)
    body = upper * trunk + (1 - upper) * leg
    arm = jnp.interp(fields[:, REACH], rings("arm").levels, form.off["arm"])
    share = jnp.clip(fields[:, ARM], 0.0, 1.0)
    return (1 - share) * body + share * arm


def _smoothstep(x: Array, low: float, high: float) -> Array:
    t = jnp.clip((x - low) / (high - low), 0.0, 1.0)
    return t * t * (3 - 2 * t)


def _wider(a: Array, b: Array) -> Array:
    """The larger of two lengths, rounded off."""
    return 0.5 * (a + b + jnp.sqrt((a - b) ** 2 + _ROUND**2))


def perimeters(form: Form, part: str) -> Float[Array, " rings"]:
    """Lengths of the garment's rings around a part [m]; of limbs, the mean of left and right."""
    p = ring_points(form, part)
    total = jnp.sum(jnp.linalg.norm(p[:, :, 1:] - p[:, :, :-1], axis=3), axis=(1, 2))
    return total if rings(part).pair else 0.5 * total


def heights(form: Form, part: str) -> Float[Array, " rings"]:
    """Mean heights of the rings around a part [m]."""
    return jnp.mean(ring_points(form, part)[..., 1], axis=(1, 2))


def make_form(
    kind: Kind,
    measures: Mapping[str, Float[Array, ""]],
    rest: Float[Array, "all 3"],
    surface: Carrier,
    charts: Charts,
    hem: Float[Array, ""],
) -> Form:
    """Fits a garment's surface to a body and to measures.

    Args:
        kind: The kind of garment.
        measures: Its measures [m].
        rest: `Body.rest_vertices` [m].
        surface: The body's `carrier`.
        charts: The charts.
        hem: Height of the hem on the default shape [m].
    """
    off = {p: jnp.zeros(len(rings(p).levels)) for p in ("torso", "leg", "arm", "skirt")}
    form = Form(surface, off)
    tape = {k: t.length(rest) for k, t in charts.tapes.items()}
    level = {k: t.level for k, t in charts.tapes.items()}
    wanted = _wanted(kind, measures, tape, level, form, hem)
    for part, goal in wanted.items():
        bare = perimeters(form, part)
        goal = _wider(goal, bare + _TIGHT)
        off = off | {part: _fit_rings(Form(surface, off), part, goal)}
    return Form(surface, off)


def _fit_rings(form: Form, part: str, goal: Float[Array, " rings"]) -> Float[Array, " rings"]:
    """How far rings stand off the carrier if they have the lengths of the goal [m]."""

    def step(wide: Array, _: None) -> tuple[Array, None]:
        now = perimeters(dataclasses.replace(form, off={**form.off, part: wide}), part)
        return wide + (goal - now) / (2 * jnp.pi), None

    return jax.lax.scan(step, form.off[part], length=STEPS)[0]


def _wanted(
    kind: Kind,
    m: Mapping[str, Float[Array, ""]],
    tape: Mapping[str, Float[Array, ""]],
    level: Mapping[str, float],
    bare: Form,
    hem: Float[Array, ""],
) -> dict[str, Float[Array, " rings"]]:
    """Lengths around trunk, limbs and skirt that the measures ask for [m]."""

    def down(part: str, top: float, bottom) -> Array:
        """0 at one height and above, 1 at a lower one, linear on below it."""
        return jnp.maximum((top - rings(part).levels) / (top - bottom), 0.0)

    ease, flare = m["ease"], m["flare"]
    out: dict[str, Array] = {}
    if kind.style == "trousers":
        waist = WAIST["trousers"]
        hip = tape["hip"] + kind.hip_ease * ease
        around = perimeters(bare, "torso")
        at_waist = jnp.interp(jnp.asarray(waist), rings("torso").levels, around)
        at_waist = at_waist - _SNUG + _WAIST_EASE["trousers"]
        out["torso"] = at_waist + jnp.minimum(down("torso", waist, level["hip"]), 1.0) * (
            hip - at_waist
        )
        thigh = tape["thigh"] + ease
        narrow = 1 + (kind.hem - 1) * down("leg", level["thigh"], _ANKLE)
        out["leg"] = thigh * narrow + flare * down("leg", level["thigh"], hem)
        return out
    chest = tape["chest"] + ease
    hip = tape["hip"] + kind.hip_ease * ease
    if kind.style in ("top", "strapless"):
        wide = _wider(chest, hip)
        down_hip = jnp.minimum(down("torso", level["chest"], level["hip"]), 1.0)
        out["torso"] = (
            chest + down_hip * (wide - chest) + flare * down("torso", level["chest"], hem)
        )
    if kind.style in ("dress", "strapless-dress", "skirt"):
        waist = WAIST[kind.style]
        around = perimeters(bare, "skirt")
        at_waist = jnp.interp(jnp.asarray(waist), rings("skirt").levels, around)
        at_waist = at_waist - _SNUG + _WAIST_EASE[kind.style]
        if kind.style == "skirt":
            hip = tape["hip"] + ease
        else:
            share = jnp.minimum(down("torso", level["chest"], waist), 1.0)
            out["torso"] = chest + share * (at_waist - chest)
        to_hip = jnp.minimum(down("skirt", waist, level["hip"]), 1.0)
        out["skirt"] = (
            at_waist + to_hip * (hip - at_waist) + flare * down("skirt", level["hip"], hem)
        )
    if kind.style in ("top", "dress"):
        upper = perimeters(bare, "arm")
        wide = upper[0] - _SNUG + kind.sleeve_ease * ease
        along = jnp.linspace(0.0, 1.0, len(rings("arm").levels))
        out["arm"] = wide * (1 - kind.taper * along)
    return out
