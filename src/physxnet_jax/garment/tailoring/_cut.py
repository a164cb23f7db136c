"""Vertices of garments cut to measure, as smooth functions of measures and shape."""

import functools
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer, eval_context
from jaxtyping import Array, Float

from ..._programs import bounded_jit
from ...body import Body, load_body
from ...errors import PhysXNetError
from ._borders import STRAPLESS_TOP, neck_row
from ._charts import Carrier, ChartName, Charts, carrier, load_charts
from ._curves import rings
from ._form import WAIST, Form, heights, make_form, place, ring_points
from ._measures import Kind, kind_of
from ._pattern import (
    CUTS,
    Pattern,
    draw_pattern,
    pattern_arrays,
    stored_arrays,
    stored_number,
    stored_pattern,
    with_borders,
)

# Places of a chart evaluated at once: one program for all.
_POINTS = 2048


_carrier_of = jax.jit(lambda rest: carrier(rest, load_charts()))


def is_traced(value: float | Array) -> bool:
    """Whether a value is known only under a transformation."""
    return isinstance(value, Tracer)


def resolve_measures(kind: str, measures: Mapping[str, float | Array | None]) -> dict[str, Array]:
    """Measures of a kind, its own where none is given.

    Raises:
        PhysXNetError: It has no such measure, or a value is out of its range.
    """
    ranges = kind_of(kind).ranges
    out = {}
    for name, value in measures.items():
        if value is None:
            continue
        if name not in ranges:
            raise PhysXNetError(f"{kind} has no {name}; it has {', '.join(ranges)}.")
        limits = ranges[name]
        if not is_traced(value) and not limits.low - 1e-6 <= float(value) <= limits.high + 1e-6:
            raise PhysXNetError(
                f"{name}={float(value):g}: {kind} is cut with {limits.low:g} to {limits.high:g} m."
            )
        out[name] = jnp.asarray(value, jnp.float32)
    return {k: out.get(k, jnp.asarray(r.default, jnp.float32)) for k, r in ranges.items()}


def class_of(kind: Kind, measures: Mapping[str, Array]) -> tuple[tuple[str, float, float], ...]:
    """The class of lengths that share a mesh: measure, low end and high end."""
    out = []
    for name, ends in kind.classes.items():
        value = measures[name]
        if is_traced(value):
            raise PhysXNetError(
                f"The mesh depends on {name}, which is traced: name the measures of a mesh in"
                " `like`, as in cut_vertices(kind, measures, like={})."
            )
        low = kind.ranges[name].low
        for end in ends:
            if float(value) <= end + 1e-6 or end == ends[-1]:
                out.append((name, low, end))
                break
            low = end
    return tuple(out)


def _reference_heights(bare: Form, charts: Charts, kind: Kind) -> tuple[Array, Array, Array]:
    """Height from which the length is measured, and heights of rings with their levels [m]."""
    style = kind.style
    parts = {"trousers": ("leg", "torso"), "top": ("torso",), "strapless": ("torso",)}
    names = parts.get(style, ("skirt",))
    here = jnp.concatenate([heights(bare, p) for p in names])
    levels = jnp.concatenate([jnp.asarray(rings(p).levels, jnp.float32) for p in names])
    if style in ("top", "dress"):
        row = neck_row(kind, charts)
        uv = np.array(
            [[np.interp(row, np.arange(len(charts.over)), charts.over[:, k]) for k in (0, 1)]]
        )
        ends = place(bare, charts, "front", jnp.asarray(uv, jnp.float32))
        return 0.5 * (ends[0][0, 1] + ends[1][0, 1]), here, levels
    if style in ("strapless", "strapless-dress"):
        trunk = heights(bare, "torso")
        at = jnp.asarray(STRAPLESS_TOP, jnp.float32)
        top = jnp.interp(at, jnp.asarray(rings("torso").levels, jnp.float32), trunk)
        return top, here, levels
    return jnp.interp(jnp.asarray(WAIST[style], jnp.float32), levels, here), here, levels


def _line(x: Array, xs: Array, ys: Array) -> Array:
    """Linear interpolation, and extrapolation beyond the ends."""
    inner = jnp.interp(x, xs, ys)
    low = ys[0] + (x - xs[0]) * (ys[1] - ys[0]) / (xs[1] - xs[0])
    high = ys[-1] + (x - xs[-1]) * (ys[-1] - ys[-2]) / (xs[-1] - xs[-2])
    return jnp.where(x < xs[0], low, jnp.where(x > xs[-1], high, inner))


def _arm_length(bare: Form) -> Array:
    """Length of the middle line of the arms' rings [m]."""
    p = ring_points(bare, "arm")
    half = p.shape[1] // 2
    left, right = jnp.mean(p[:, :half], axis=(1, 2)), jnp.mean(p[:, half:], axis=(1, 2))
    centre = 0.5 * (left + right * jnp.asarray([[-1.0, 1.0, 1.0]]))
    return jnp.sum(jnp.linalg.norm(centre[1:] - centre[:-1], axis=1))


@functools.cache
def _usual_arm() -> float:
    stored = stored_number("usual_arm")
    return measure_usual_arm() if stored is None else stored


def measure_usual_arm() -> float:
    """Length of the default shape's arms along the middles of their rings [m]."""
    body = load_body()
    with eval_context():
        surface = _carrier_of(body.rest_vertices(body.default_shape()))
        return float(jax.jit(lambda s: _arm_length(_bare(s)))(surface))


def _bare(surface: Carrier) -> Form:
    off = {p: jnp.zeros(len(rings(p).levels)) for p in ("torso", "leg", "arm", "skirt")}
    return Form(surface, off)


def _levels(
    kind: Kind, measures: Mapping[str, Array], bare: Form, charts: Charts
) -> tuple[dict[str, Array], Array]:
    """Where a garment ends on the default shape, and the height of its hem on this one [m]."""
    top, here, levels = _reference_heights(bare, charts, kind)
    hem = top - measures["length"]
    out = {"hem": _line(hem, here, levels)}
    if "sleeve" in measures:
        out["reach"] = measures["sleeve"] * (_usual_arm() / _arm_length(bare))
    if "neckline" in measures:
        out["neckline"] = measures["neckline"]
    return out, hem


def _spread(default: float, low: float, high: float) -> tuple[float, float, float]:
    """Ends of a class and what its mesh is drawn for: the default if it lies well inside."""
    margin = 0.15 * (high - low)
    inside = low + margin <= default <= high - margin
    return low, default if inside else 0.5 * (low + high), high


@functools.partial(jax.jit, static_argnames="name")
def _fitted(name: str, measures, rest, surface: Carrier, hem):
    return make_form(kind_of(name), measures, rest, surface, load_charts(), hem).off


@functools.partial(jax.jit, static_argnames="chart")
def _placed(surface: Carrier, off, uv, chart: ChartName):
    return place(Form(surface, off), load_charts(), chart, uv)[0]


@functools.partial(jax.jit, static_argnames="name")
def _levels_of(name: str, measures, surface: Carrier):
    return _levels(kind_of(name), measures, _bare(surface), load_charts())[0]


@functools.cache
def pattern_of(name: str, ends: tuple[tuple[str, float, float], ...]) -> Pattern:
    """The pattern of a kind and class: from the package for its usual measures, else drawn."""
    stored = stored_pattern(name)
    if stored is not None and class_of(kind_of(name), resolve_measures(name, {})) == ends:
        return stored
    return draw_class(name, ends)


def draw_class(name: str, ends: tuple[tuple[str, float, float], ...]) -> Pattern:
    """Draws the pattern of a kind and class on the default shape, in about ten seconds."""
    kind, charts, body = kind_of(name), load_charts(), load_body()
    with eval_context():
        rest = body.rest_vertices(body.default_shape())
        surface = _carrier_of(rest)
        measures = resolve_measures(name, {})
        limits = {k: _spread(kind.ranges[k].default, low, high) for k, low, high in ends}
        if "neckline" in kind.ranges:
            r = kind.ranges["neckline"]
            limits["neckline"] = _spread(r.default, r.low, r.high)
        triples: dict[str, list[float]] = {}
        for end in range(3):
            chosen = measures | {k: jnp.asarray(v[end], jnp.float32) for k, v in limits.items()}
            for level, value in _levels_of(name, chosen, surface).items():
                triples.setdefault(level, []).append(float(value))
        middle = measures | {k: jnp.asarray(v[1], jnp.float32) for k, v in limits.items()}
        hem = jnp.asarray(triples["hem"][1], jnp.float32)
        form = Form(surface, _fitted(name, middle, rest, surface, hem))

        def at(chart: ChartName, uv: np.ndarray) -> np.ndarray:
            size = -(-len(uv) // _POINTS) * _POINTS
            padded = np.resize(uv, (size, 2)).astype(np.float32)
            points = [
                _placed(form.carrier, form.off, p, chart) for p in padded.reshape(-1, _POINTS, 2)
            ]
            return np.concatenate([np.asarray(p, np.float64) for p in points])[: len(uv)]

        pattern = draw_pattern(
            kind, {k: (v[0], v[1], v[2]) for k, v in triples.items()}, at, charts
        )
        return with_borders(pattern, at)


def _places(pattern: Pattern, levels: Mapping[str, Array]) -> dict[str, Array]:
    """Places of every panel vertex on its chart."""
    out = {}
    for name, panel in pattern.panels.items():
        uv = jnp.asarray(panel.middle, jnp.float32)
        for level, (low, mid, high) in pattern.levels.items():
            x, moves = levels[level], panel.moves[level].astype(np.float32)
            to_low = (x - mid) * (x - high) / ((low - mid) * (low - high))
            to_high = (x - low) * (x - mid) / ((high - low) * (high - mid))
            uv = uv + to_low * moves[0] + to_high * moves[1]
        out[name] = uv
    return out


@bounded_jit(static_argnames=("name", "pattern"), keep=6)
def cut(
    name: str, pattern: Pattern, measures: Mapping[str, Array], rest: Float[Array, "all 3"]
) -> tuple[Float[Array, "vertices 3"], dict[str, Array]]:
    """Vertices of a garment [m], and the places of its panels on their charts.

    Args:
        name: Kind of garment.
        pattern: Pattern of its class.
        measures: All its measures [m].
        rest: `Body.rest_vertices` of the person it is cut for [m].
    """
    kind, charts = kind_of(name), load_charts()
    surface = carrier(rest, charts)
    levels, hem = _levels(kind, measures, _bare(surface), charts)
    form = make_form(kind, measures, rest, surface, charts, levels["hem"])
    places = _places(pattern, levels)
    parts = [
        half
        for key, panel in pattern.panels.items()
        for half in place(form, charts, panel.chart, places[key])
    ]
    count = np.bincount(pattern.owner, minlength=pattern.num_vertices).astype(np.float32)
    total = jnp.zeros((pattern.num_vertices, 3), jnp.float32)
    vertices = total.at[pattern.owner].add(jnp.concatenate(parts)) / count[:, None]
    return _level_borders(kind, pattern, vertices, hem), places


def stored_cut(
    name: str, measures: Mapping[str, Array], rest: Float[Array, "all 3"]
) -> tuple[Float[Array, "vertices 3"], dict[str, Array]] | None:
    """What `cut` gives for a kind's own measures on the built-in body, without compiling it.

    None for other measures or another body, and where the package has no such file.
    """
    arrays = stored_arrays(CUTS)
    ranges = kind_of(name).ranges
    body = load_body()
    if (
        f"{name}/vertices" not in arrays
        or any(float(x) != np.float32(ranges[k].default) for k, x in measures.items())
        or not np.array_equal(rest, body.rest_vertices(body.default_shape()))
    ):
        return None
    start = f"{name}/places/"
    places = {k[len(start) :]: jax.device_put(v) for k, v in arrays.items() if k.startswith(start)}
    return jax.device_put(arrays[f"{name}/vertices"]), places


def cut_usual(name: str) -> dict[str, np.ndarray]:
    """Cuts a kind with its own measures on the built-in body, as arrays of the package's file."""
    body = load_body()
    measures = resolve_measures(name, {})
    pattern = pattern_of(name, class_of(kind_of(name), measures))
    vertices, places = cut(name, pattern, measures, body.rest_vertices(body.default_shape()))
    out = {f"{name}/vertices": np.asarray(vertices)}
    return out | {f"{name}/places/{k}": np.asarray(v) for k, v in places.items()}


def _level_borders(
    kind: Kind, pattern: Pattern, vertices: Float[Array, "vertices 3"], hem: Array
) -> Float[Array, "vertices 3"]:
    """Makes hems level and cuffs flat; cloth beside them follows."""
    for name, edges in pattern.loops.items():
        if name == "neckline":
            continue
        ring = np.unique(edges)
        p = vertices[ring]
        if name.startswith("cuff"):
            centre = jnp.mean(p, axis=0, keepdims=True)
            normal = _least_direction((p - centre).T @ (p - centre))
            move = -((p - centre) @ normal)[:, None] * normal[None]
        else:
            height = hem if name == "hem" else jnp.mean(p[:, 1])
            move = jnp.zeros_like(p).at[:, 1].set(height - p[:, 1])
        near, share = pattern.beside[name]
        vertices = vertices + jnp.sum(move[near] * share[..., None], axis=1)
    return vertices


def _least_direction(spread: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """The direction in which points spread least: a flat ring's normal, by inverse iteration."""
    inverse = jnp.linalg.inv(spread + 1e-6 * jnp.trace(spread) * jnp.eye(3))
    n = jnp.asarray([0.6, -0.6, 0.5])
    for _ in range(8):
        n = inverse @ n
        n = n / jnp.linalg.norm(n)
    return n


def cut_vertices(
    kind: str,
    measures: Mapping[str, float | Array],
    *,
    like: Mapping[str, float] | None = None,
    body: Body | None = None,
    shape: Float[Array, " shapes"] | None = None,
) -> Float[Array, "vertices 3"]:
    """Vertices of a garment cut to measure, as a smooth function of measures and shape.

    Args:
        kind: See `tailor`.
        measures: Its measures [m]; may be traced.
        like: Measures whose mesh is used, not traced; ``measures`` if None.
        body: The body; the built-in one if None.
        shape: Shape parameters of the body; may be traced.

    Returns:
        Rest positions on the body in its rest pose [m], shape [vertices, 3].

    Raises:
        PhysXNetError: A measure is unknown or out of range.

    Example:
        >>> def width(ease):
        ...     return jnp.ptp(cut_vertices("shorts", {"ease": ease})[:, 0])
        >>> bool(jax.grad(width)(0.1) > 0.05)
        True
    """
    body = load_body() if body is None else body
    shape = body.default_shape() if shape is None else shape
    chosen = resolve_measures(kind, measures)
    fixed = chosen
    if like is not None:
        # Constants that are made under `jit` would be traced.
        with eval_context():
            fixed = resolve_measures(kind, like)
    style = kind_of(kind)
    pattern = pattern_of(kind, class_of(style, fixed))
    return cut(kind, pattern, chosen, body.rest_vertices(shape))[0]


def draw_usual_pattern(name: str) -> dict[str, np.ndarray]:
    """Draws the pattern of a kind's usual measures, as arrays of the package's asset."""
    ends = class_of(kind_of(name), resolve_measures(name, {}))
    return pattern_arrays(name, draw_class(name, ends))
