"""Patterns: the panels of a garment, their meshes, and how measures move them."""

import dataclasses
import functools
import importlib.resources
from collections.abc import Callable, Mapping

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Int
from scipy.sparse.linalg import splu
from scipy.spatial import KDTree

from ._borders import Side, borders
from ._charts import ChartName, Charts
from ._flatten import flatten, nearest_triangle
from ._measures import Kind
from ._mesher import mesh_polygon
from ._outline import SKIRT_QUARTER

ASSET = "patterns_cc0.npz"
CUTS = "cuts_cc0.npz"
# Length of edges of a pattern [m].
EDGE = 0.0145
# Vertices nearer to a border than this follow when it is levelled [m].
LEVELLED = 0.15


@dataclasses.dataclass(frozen=True, eq=False)
class Panel:
    """The left half of a panel.

    Attributes:
        chart: Chart on which it is drawn.
        middle: Places on the chart for the middle of the class, shape [vertices, 2].
        moves: How places move to the low and the high end of each level, shape [2, vertices, 2].
        faces: Triangles, anticlockwise on the pattern.
        pattern: Places on the pattern [m], shape [vertices, 2].
        sides: Vertices of each side of the border, in its direction; empty once it is sewn.
        axis: Vertices in the middle, if both halves are one piece of cloth; or None.
        outward: Triangles of the left half face outwards as they are; else they are turned.
    """

    chart: ChartName
    middle: Float[np.ndarray, "vertices 2"]
    moves: Mapping[str, Float[np.ndarray, "2 vertices 2"]]
    faces: Int[np.ndarray, "faces 3"]
    pattern: Float[np.ndarray, "vertices 2"]
    sides: Mapping[str, Int[np.ndarray, " side"]]
    axis: Int[np.ndarray, " axis"] | None
    outward: bool


@dataclasses.dataclass(frozen=True, eq=False)
class Pattern:
    """The mesh that all garments of a kind and class share.

    Attributes:
        panels: Left halves of the panels by name.
        owner: Vertex of the garment of each panel vertex, of both halves, see `corners`.
        faces: Triangles of the garment.
        loops: Edges of each named curve around the garment.
        levels: Low end, middle and high end of each level.
        num_vertices: Number of vertices of the garment.
        beside: For each curve, the vertices of it that each vertex follows when it is moved
            (as indices into its sorted vertices), and how closely, shape [vertices, 3].
    """

    panels: Mapping[str, Panel]
    owner: Int[np.ndarray, " corners"]
    faces: Int[np.ndarray, "faces 3"]
    loops: Mapping[str, Int[np.ndarray, "edges 2"]]
    levels: Mapping[str, tuple[float, float, float]]
    num_vertices: int
    beside: Mapping[str, tuple[Int[np.ndarray, "vertices 3"], Float[np.ndarray, "vertices 3"]]]


Surface = Callable[[ChartName, Float[np.ndarray, "points 2"]], Float[np.ndarray, "points 3"]]
LOOPS = ("neckline", "top", "waist", "hem", "cuff")


def draw_pattern(
    kind: Kind,
    levels: Mapping[str, tuple[float, float, float]],
    surface: Surface,
    charts: Charts,
) -> Pattern:
    """Draws and meshes a garment's pattern, in a few seconds.

    Args:
        kind: The kind of garment.
        levels: Low end, middle and high end of each level.
        surface: The garment's surface on the default shape: places of a chart to points [m].
        charts: The charts.
    """
    middle = {k: v[1] for k, v in levels.items()}
    drawn = borders(kind, middle, charts)
    marks = _marks(drawn, surface)
    counts = {name: len(v) for (_, name), v in marks.items()}
    panels: dict[str, Panel] = {}
    variants = {}
    for level in levels:
        for end in (0, 1):
            moved = borders(kind, middle | {level: levels[level][2 * end]}, charts)
            variants[level, end] = moved, _marks(moved, surface, counts)
    for name, (chart, sides) in drawn.items():
        border, ids = _sample(name, sides, marks)
        uv, faces, pattern = _mesh(name, chart, border, surface)
        moves = {}
        spread = _harmonic(faces, len(border), len(uv))
        for level in levels:
            ends = np.zeros((2, len(uv), 2))
            for end in (0, 1):
                moved, theirs = variants[level, end]
                ends[end] = spread(_sample(name, moved[name][1], theirs)[0] - border)
            moves[level] = ends
        panels[name] = Panel(
            chart,
            uv,
            moves,
            faces,
            pattern,
            ids,
            on_axis(pattern[: len(border)], pattern),
            name.rpartition(" ")[2] == "front",
        )
    owner, faces, loops = _sew(panels)
    return Pattern(panels, owner, faces, loops, dict(levels), int(owner.max()) + 1, {})


Marks = Mapping[tuple[str, str], Float[np.ndarray, " marks"]]


def _marks(
    drawn: Mapping[str, tuple[ChartName, list[Side]]],
    surface: Surface,
    counts: Mapping[str, int] | None = None,
) -> Marks:
    """Marks on each side of each panel, as fractions of its drawn points, evenly spaced on cloth.

    Args:
        drawn: Borders of the panels.
        surface: The garment's surface on the default shape.
        counts: Number of marks of each side by its name; by its length if None.
    """
    arcs = {}
    for panel, (chart, sides) in drawn.items():
        for side in sides:
            p = surface(chart, side.points)
            arcs[panel, side.name] = np.concatenate(
                [[0.0], np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1))]
            )
    if counts is None:
        counts = {name: max(2, round(arc[-1] / EDGE) + 1) for (_, name), arc in arcs.items()}
    return {
        (panel, name): np.interp(
            np.linspace(0.0, arc[-1], counts[name]), arc, np.linspace(0.0, 1.0, len(arc))
        )
        for (panel, name), arc in arcs.items()
    }


def _sample(
    panel: str, sides: list[Side], marks: Marks
) -> tuple[Float[np.ndarray, "border 2"], dict[str, Int[np.ndarray, " side"]]]:
    """Marks of a whole border, and the marks of each of its sides."""
    points, ids, start = [], {}, 0
    total = sum(len(marks[panel, s.name]) - 1 for s in sides)
    for side in sides:
        share = marks[panel, side.name]
        at = np.linspace(0.0, 1.0, len(side.points))
        p = np.column_stack([np.interp(share, at, side.points[:, k]) for k in range(2)])
        points.append(p[:-1])
        index = (start + np.arange(len(share))) % total
        ids[side.name] = index[::-1] if side.backwards else index
        start += len(share) - 1
    return np.concatenate(points), ids


def _mesh(
    name: str, chart: ChartName, border: Float[np.ndarray, "border 2"], surface: Surface
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Meshes a panel evenly on its pattern: first roughly on the chart, to find the pattern."""

    def turned(p: np.ndarray) -> np.ndarray:
        return (
            np.column_stack([2 * SKIRT_QUARTER - p[:, 0], p[:, 1]]) if name == "skirt back" else p
        )

    rough, faces = mesh_polygon(turned(border), 1.2 * EDGE)
    solid = surface(chart, turned(rough))
    flat = flatten(solid, faces, rough, on_axis=on_axis(turned(border), rough), steps=60)
    p, tri = mesh_polygon(flat[: len(border)], EDGE)
    near, share = nearest_triangle(p, flat, faces)
    uv = np.einsum("nk,nkc->nc", share, rough[faces[near]])
    uv[: len(border)] = turned(border)
    return turned(uv), tri, p


def on_axis(
    border: Float[np.ndarray, "border 2"], points: Float[np.ndarray, "points 2"]
) -> Int[np.ndarray, " axis"] | None:
    """Points in the middle of a panel that is one piece with its mirror image, else None."""
    straight = np.abs(border[:, 0]) < 1e-9
    if border[:, 0].min() < -1e-6 or straight.sum() < 3:
        return None
    return np.flatnonzero(np.abs(points[:, 0]) < 1e-9)


def _harmonic(faces: Int[np.ndarray, "faces 3"], fixed: int, n: int):
    """Extends moves of the border into a panel."""
    i = np.concatenate([faces[:, k] for k in range(3)])
    j = np.concatenate([faces[:, (k + 1) % 3] for k in range(3)])
    beside = sp.coo_matrix((np.ones(len(i)), (i, j)), (n, n))
    beside = ((beside + beside.T) > 0).astype(np.float64)
    laplacian = sp.csr_matrix(sp.diags(np.asarray(beside.sum(axis=1)).ravel()) - beside)
    inner = splu(sp.csc_matrix(laplacian[fixed:, fixed:]))
    outer = laplacian[fixed:, :fixed]

    def spread(moved: Float[np.ndarray, "fixed 2"]) -> Float[np.ndarray, "vertices 2"]:
        return np.concatenate([moved, inner.solve(-(outer @ moved))])

    return spread


def _sew(
    panels: Mapping[str, Panel],
) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Sews panels to each other and to their mirror images."""
    first, total = {}, 0
    for name, panel in panels.items():
        for half in ("left", "right"):
            first[name, half] = total
            total += len(panel.middle)
    a, b = [], []
    users: dict[str, list[str]] = {}
    for name, panel in panels.items():
        for side, index in panel.sides.items():
            if side.startswith(("middle", "skirt middle")):
                a.append(first[name, "left"] + index)
                b.append(first[name, "right"] + index)
            users.setdefault(side, []).append(name)
    for side, names in users.items():
        for other in names[1:]:
            for half in ("left", "right"):
                a.append(first[names[0], half] + panels[names[0]].sides[side])
                b.append(first[other, half] + panels[other].sides[side])
    i, j = np.concatenate(a), np.concatenate(b)
    graph = sp.coo_matrix((np.ones(len(i)), (i, j)), (total, total))
    _, owner = sp.csgraph.connected_components(graph, directed=False)
    # Number vertices in the order of their first appearance.
    _, order, owner = np.unique(owner, return_index=True, return_inverse=True)
    rank = np.empty(len(order), np.int64)
    rank[np.argsort(order)] = np.arange(len(order))
    owner = rank[owner]
    faces, loops = [], {}
    for name, panel in panels.items():
        for half in ("left", "right"):
            tri = panel.faces + first[name, half]
            faces.append(tri if panel.outward == (half == "left") else tri[:, [0, 2, 1]])
            for side, index in panel.sides.items():
                base = side.split(" ")[0]
                if base in LOOPS:
                    key = f"cuff {half}" if base == "cuff" else base
                    ring = owner[first[name, half] + index]
                    loops.setdefault(key, []).append(np.column_stack([ring[:-1], ring[1:]]))
    edges = {k: np.unique(np.sort(np.concatenate(v), axis=1), axis=0) for k, v in loops.items()}
    return owner, owner[np.concatenate(faces)], edges


def with_borders(pattern: Pattern, surface: Surface) -> Pattern:
    """Finds out which vertices follow the borders of a pattern when these are levelled."""
    points = np.zeros((pattern.num_vertices, 3))
    start = 0
    for panel in pattern.panels.values():
        p = surface(panel.chart, panel.middle)
        for mirror in (1.0, -1.0):
            points[pattern.owner[start : start + len(p)]] = p * [mirror, 1, 1]
            start += len(p)
    beside = {}
    for name, edges in pattern.loops.items():
        ring = np.unique(edges)
        distance, near = KDTree(points[ring]).query(points, k=3)
        share = 1.0 / np.maximum(distance, 1e-9)
        share /= share.sum(axis=1, keepdims=True)
        fade = np.maximum(1.0 - distance[:, :1] / LEVELLED, 0.0) ** 2
        fade[ring] = 1.0
        beside[name] = (near, (fade * share).astype(np.float32))
    return dataclasses.replace(pattern, beside=beside)


def pattern_arrays(name: str, pattern: Pattern) -> dict[str, np.ndarray]:
    """Arrays of a pattern for the package's asset, by names that begin with the kind's."""
    out: dict[str, np.ndarray] = {
        f"{name}/owner": pattern.owner.astype(np.uint16),
        f"{name}/faces": pattern.faces.astype(np.uint16),
        f"{name}/levels": np.array(list(pattern.levels.values())),
        f"{name}/level_names": np.array(list(pattern.levels)),
    }
    for key, edges in pattern.loops.items():
        near, share = pattern.beside[key]
        out[f"{name}/loop/{key}/edges"] = edges.astype(np.uint16)
        out[f"{name}/loop/{key}/near"] = near.astype(np.uint16)
        out[f"{name}/loop/{key}/share"] = share.astype(np.float32)
    for key, panel in pattern.panels.items():
        at = f"{name}/panel/{key}"
        out[f"{at}/chart"] = np.array(panel.chart)
        out[f"{at}/middle"] = panel.middle.astype(np.float32)
        out[f"{at}/moves"] = np.stack(list(panel.moves.values())).astype(np.float32)
        out[f"{at}/faces"] = panel.faces.astype(np.uint16)
        out[f"{at}/pattern"] = panel.pattern.astype(np.float32)
        out[f"{at}/axis"] = np.array([] if panel.axis is None else panel.axis, np.int32)
        out[f"{at}/outward"] = np.array(panel.outward)
    return out


@functools.cache
def stored_arrays(asset: str) -> dict[str, np.ndarray]:
    """Arrays of one of the package's files; none if it isn't there."""
    resource = importlib.resources.files("physxnet_jax.garment") / "assets" / asset
    with importlib.resources.as_file(resource) as path:
        if not path.is_file():
            return {}
        with np.load(path) as data:
            return {k: data[k] for k in data.files}


def stored_number(name: str) -> float | None:
    """A number that the package stores beside the patterns; None if it isn't there."""
    arrays = stored_arrays(ASSET)
    return float(arrays[name]) if name in arrays else None


def stored_pattern(name: str) -> Pattern | None:
    """The pattern of a kind's usual class from the package; None if it isn't there."""
    arrays = stored_arrays(ASSET)
    if f"{name}/owner" not in arrays:
        return None

    def names(part: str) -> list[str]:
        start = f"{name}/{part}/"
        return list(
            dict.fromkeys(k[len(start) :].split("/")[0] for k in arrays if k.startswith(start))
        )

    whole = np.int64
    levels = [str(x) for x in arrays[f"{name}/level_names"]]
    panels = {}
    for key in names("panel"):
        get = {
            k: arrays[f"{name}/panel/{key}/{k}"]
            for k in ("chart", "middle", "moves", "faces", "pattern", "axis", "outward")
        }
        panels[key] = Panel(
            str(get["chart"]),  # pyright: ignore[reportArgumentType]
            get["middle"].astype(np.float64),
            dict(zip(levels, get["moves"].astype(np.float64))),
            get["faces"].astype(whole),
            get["pattern"].astype(np.float64),
            {},
            get["axis"].astype(whole) if len(get["axis"]) else None,
            bool(get["outward"]),
        )
    loops, beside = {}, {}
    for key in names("loop"):
        get = {k: arrays[f"{name}/loop/{key}/{k}"] for k in ("edges", "near", "share")}
        loops[key] = get["edges"].astype(whole)
        beside[key] = get["near"].astype(whole), get["share"]
    owner = arrays[f"{name}/owner"].astype(whole)
    ends = {
        k: (float(a), float(b), float(c)) for k, (a, b, c) in zip(levels, arrays[f"{name}/levels"])
    }
    return Pattern(
        panels,
        owner,
        arrays[f"{name}/faces"].astype(whole),
        loops,
        ends,
        int(owner.max()) + 1,
        beside,
    )
