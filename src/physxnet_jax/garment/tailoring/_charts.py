"""The tailor's charts: a body's surface over which patterns are drawn, as a smooth function."""

import dataclasses
import functools
import importlib.resources
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.spatial import KDTree

from ...body import NUM_BODY_VERTICES, load_body
from ...geometry import smoothing_matrix, vertex_normals
from .._cut import split_quads
from ._build import CARRIER_PASSES
from ._grid import extension, spline

ASSET = "charts_cc0.npz"
HEIGHT, REACH, ARM, FREE = range(4)
"""Fields of a chart: height [m] and distance along the arm [m] on the default shape, share of the
arm, free distance before the surface [m]."""
ChartName = Literal["front", "back", "skirt"]
CHARTS: tuple[ChartName, ...] = ("front", "back", "skirt")
# Between a skirt without ease and the outline of the skin [m].
_SKIRT_CLEARANCE = 0.008
# What the smoothed tights lie inside the tights is made up for, and this much more [m].
_MARGIN = 0.002


@dataclasses.dataclass(frozen=True, eq=False)
class Chart:
    """Half of a body's front or back, flattened.

    Attributes:
        origin: Place of the first node [m], shape [2].
        refs: Vertices of the tights at each node, or of the skin, shape [rows, columns, k].
        weights: Their weights, which sum to 1, shape [rows, columns, k].
        fields: `HEIGHT`, `REACH`, `ARM`, `FREE`, shape [rows, columns, 4].
        inside: Nodes that lie on the surface, shape [rows, columns]; the others continue it.
    """

    origin: Float[np.ndarray, "2"]
    refs: Int[np.ndarray, "rows columns k"]
    weights: Float[np.ndarray, "rows columns k"]
    fields: Float[np.ndarray, "rows columns 4"]
    inside: Bool[np.ndarray, "rows columns"]

    def field(self, uv: Float[np.ndarray, "points 2"], which: int) -> Float[np.ndarray, " points"]:
        """A field at places of the chart [m]."""
        index, weight = spline(self.origin, uv, self.fields.shape[:2])
        flat = self.fields[..., which].astype(np.float64).ravel()
        return (flat[index] * weight).sum(axis=1)


@dataclasses.dataclass(frozen=True, eq=False)
class Tape:
    """Where a tape lies around the body.

    Attributes:
        level: Height on the default shape [m].
        refs: Ends of edges of the skin that it crosses, in order, shape [corners, 2].
        weights: Shares of the ends, shape [corners, 2].
    """

    level: float
    refs: Int[np.ndarray, "corners 2"]
    weights: Float[np.ndarray, "corners 2"]

    def length(self, rest: Float[Array, "all 3"]) -> Float[Array, ""]:
        """Its length on a body at rest [m]."""
        p = jnp.sum(rest[self.refs] * self.weights[..., None], axis=1)
        return jnp.sum(jnp.linalg.norm(p - jnp.roll(p, -1, axis=0), axis=1))


@dataclasses.dataclass(frozen=True, eq=False)
class Charts:
    """Front and back, and the seams where they meet.

    Attributes:
        front: The left half of the front of the tights.
        back: The left half of their back.
        skirt: The left half of the convex outline of trunk and legs; below the hip, of all that
            lies between the hip and there.
        skirt_heights: Vertices of the skin whose mean height is that of a row of the skirt's grid,
            and their weights, both of shape [rows, 8, 2].
        middles: The middle of front and of back, from the neck to the crotch.
        inseam: From the crotch to the ankle, rows (u, v of the front, u, v of the back).
        side: From the ankle over the armpit to the wrist.
        over: From the wrist over the shoulder to the neck.
        armpit: Row of ``side`` at the armpit.
        tapes: Where chest, waist, hip and thigh are measured.
    """

    front: Chart
    back: Chart
    skirt: Chart
    skirt_heights: tuple[Int[np.ndarray, "rows 8 2"], Float[np.ndarray, "rows 8 2"]]
    middles: dict[str, Float[np.ndarray, "middle 2"]]
    inseam: Float[np.ndarray, "inseam 4"]
    side: Float[np.ndarray, "side 4"]
    over: Float[np.ndarray, "over 4"]
    armpit: int
    tapes: dict[str, Tape]

    def chart(self, name: ChartName) -> Chart:
        """A chart by name."""
        return getattr(self, name)

    def start(self, name: ChartName, right: bool) -> int:
        """Number of a chart's first node: those of the left side come first."""
        sizes = [self.chart(n).fields[..., 0].size for n in CHARTS]
        at = CHARTS.index(name)
        return sum(sizes[:at]) + (sum(sizes) if right else 0)


@functools.cache
def load_charts() -> Charts:
    """Loads the charts of the built-in body."""
    resource = importlib.resources.files("physxnet_jax.garment") / "assets" / ASSET
    with importlib.resources.as_file(resource) as path, np.load(path) as data:
        return charts_from_arrays({k: data[k] for k in data.files})


def charts_from_arrays(arrays: dict[str, np.ndarray]) -> Charts:
    """Charts from the arrays of `build_charts`."""

    def chart(name: str) -> Chart:
        parts = {
            k: arrays[f"{name}_{k}"] for k in ("origin", "refs", "weights", "fields", "inside")
        }
        parts["refs"] = parts["refs"].astype(np.int32)
        return Chart(**parts)

    side = arrays["side"]
    return Charts(
        chart("front"),
        chart("back"),
        chart("skirt"),
        (arrays["skirt_height_refs"].astype(np.int32), arrays["skirt_height_weights"]),
        {name: arrays[f"middle_{name}"] for name in ("front", "back")},
        arrays["inseam"],
        side,
        arrays["over"],
        int(np.argmax(side[:, 1] + side[:, 3])),
        {
            name: Tape(
                float(arrays[f"{name}_level"]),
                arrays[f"{name}_refs"].astype(np.int32),
                arrays[f"{name}_weights"],
            )
            for name in ("chest", "waist", "hip", "thigh")
        },
    )


Carrier = Float[Array, "nodes 7"]
"""The smooth surface that garments are cut on, for one body: position, unit normal and clearance
at the nodes of all charts, see `Charts.start`."""


@functools.cache
def _tights() -> dict[str, np.ndarray]:
    """Tables of the helper tights: quads split in four, neighbours, mirrored vertices."""
    body = load_body()
    rest = np.asarray(body.bases, dtype=np.float64)[0]
    quads = np.asarray(body.tights_quads)
    rows, faces = split_quads(quads, len(rest))
    p, skin = rows @ rest, rest[:NUM_BODY_VERTICES]
    mean = smoothing_matrix(faces, len(p)).tocoo()
    mirrors = (KDTree(x).query(x * [-1, 1, 1])[1] for x in (p, skin))
    mirror, skin_mirror = (np.asarray(m, np.int32) for m in mirrors)
    return {
        "corners": np.unique(quads),
        "quads": quads,
        "faces": faces,
        "to": mean.row.astype(np.int32),
        "from": mean.col.astype(np.int32),
        "share": mean.data.astype(np.float32),
        "mirror": mirror,
        "skin_mirror": skin_mirror,
    }


def carrier(rest: Float[Array, "all 3"], charts: Charts) -> Carrier:
    """The surface that garments are cut on, for a body at rest.

    Args:
        rest: `Body.rest_vertices` [m].
        charts: The charts.
    """
    t = _tights()
    points = jnp.concatenate([rest[t["corners"]], jnp.mean(rest[t["quads"]], axis=1)])

    def mean(x: Array) -> Array:
        return jnp.zeros_like(x).at[t["to"]].add(t["share"][:, None] * x[t["from"]])

    smooth = jax.lax.fori_loop(0, CARRIER_PASSES, lambda _, x: mean(x), points)
    normals = vertex_normals(smooth, jax.device_put(t["faces"]))
    # Smoothing draws in what bulges; cloth keeps off the highest point around it.
    gap = jnp.maximum(jnp.sum((points - smooth) * normals, axis=1), 0.0)
    for _ in range(2):
        gap = jnp.maximum(gap, jax.ops.segment_max(gap[t["from"]], t["to"], len(gap)))
    gap = gap[:, None]
    for _ in range(3):
        gap = mean(gap)
    for _ in range(4):
        normals = mean(normals)
    table = jnp.concatenate([smooth, normals, gap + _MARGIN], axis=1)

    def on_tights(refs: Int[np.ndarray, "rows columns 3"], chart: Chart) -> Array:
        out = jnp.sum(table[refs] * chart.weights[..., None], axis=2).reshape(-1, 7)
        for target, near, far, share in extension(chart.inside):
            beyond = 2 * out[near] - out[far]
            # Clearance doesn't go on growing.
            beyond = beyond.at[..., 6].set(out[near][..., 6])
            out = out.at[target].set(jnp.sum(share.astype(np.float32)[..., None] * beyond, axis=1))
        n = out[:, 3:6]
        n = n / jnp.maximum(jnp.linalg.norm(n, axis=1, keepdims=True), 1e-6)
        return jnp.concatenate([out[:, :3], n, out[:, 6:]], axis=1)

    def around(refs: Int[np.ndarray, "rows columns 4"], sign: float) -> Array:
        p = jnp.sum(rest[refs] * charts.skirt.weights[..., None], axis=2)
        level_refs, level_weights = charts.skirt_heights
        level = jnp.mean(jnp.sum(rest[level_refs][..., 1] * level_weights, axis=2), axis=1)
        p = p.at[..., 1].set(level[:, None])
        along = jnp.concatenate(
            [p[:, 1:2] - p[:, :1], p[:, 2:] - p[:, :-2], p[:, -1:] - p[:, -2:-1]], 1
        )
        n = sign * jnp.stack([-along[..., 2], jnp.zeros_like(along[..., 0]), along[..., 0]], axis=2)
        n = n / jnp.linalg.norm(n, axis=2, keepdims=True)
        clear = jnp.full_like(p[..., :1], _SKIRT_CLEARANCE)
        return jnp.concatenate([p, n, clear], axis=2).reshape(-1, 7)

    parts = []
    for right in (False, True):
        for name in CHARTS:
            refs = charts.chart(name).refs
            if name == "skirt":
                mirror = t["skin_mirror"]
                parts.append(around(mirror[refs] if right else refs, -1.0 if right else 1.0))
            else:
                refs = t["mirror"][refs] if right else refs
                parts.append(on_tights(refs, charts.chart(name)))
    return jnp.concatenate(parts)


def place_table(
    name: ChartName, right: bool
) -> tuple[Int[np.ndarray, "nodes k"], Float[np.ndarray, "nodes k"]]:
    """Vertices of the body (helpers included) at the nodes of a chart, and their weights."""
    chart, t = load_charts().chart(name), _tights()
    refs = chart.refs.reshape(-1, chart.refs.shape[-1])
    weights = np.clip(chart.weights.reshape(refs.shape), 0.0, None)
    weights = weights / weights.sum(axis=1, keepdims=True)
    if name == "skirt":
        return (t["skin_mirror"][refs] if right else refs), weights
    if right:
        refs = t["mirror"][refs]
    # A vertex of the split tights is a corner, or the centre of a quad.
    corners, quads = t["corners"], t["quads"]
    table = np.concatenate([np.repeat(corners[:, None], 4, axis=1), quads])
    return table[refs].reshape(len(refs), -1), np.repeat(weights / 4, 4, axis=1)
