"""Draws the tailor's charts: the front and the back of the helper tights, flattened."""

import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from ...body import Body
from ...geometry import (
    boundary_loops,
    closest_points,
    make_mesh,
    smoothing_matrix,
    vertex_normals,
)
from .._cut import cut, split_quads
from ._flatten import flatten, nearest_triangle
from ._grid import BEYOND, SPACING, extension
from ._outline import skirt_grid, tapes

# Depth of the side seam of the torso [m]; the spine lies too far back.
_TORSO_DEPTH = 0.03
_TORSO = ("Hips", "LowerBack", "Spine", "Spine1")
_ANKLE = -0.77
# Above this height the middle of front and back is straight on the pattern [m].
_STRAIGHT = 0.0
# Passes that smooth the seam, the carrier, and the share of the limbs.
_SEAM_PASSES, CARRIER_PASSES, _SHARE_PASSES, _LEAST_PASSES = 60, 10, 6, 3
_FARTHEST = 0.25
# Closer vertices of the surface only show how it is meshed [m].
_NEAREST = 0.015


def build_charts(body: Body) -> dict[str, np.ndarray]:
    """Draws the charts of a body's helper tights, in about ten seconds.

    Args:
        body: The body, symmetric in its default shape.

    Returns:
        Arrays of the asset that `load_charts` reads: for the left half of front and back, a grid
        over the flattened surface. Its nodes hold a point of the tights (three vertices and their
        weights), the height [m], the distance along the arm [m], the share of the arm, and the
        free distance before the surface [m]. Besides, the seams where front and back meet; a grid
        over the left half of the body's convex outline, for skirts; and the outlines around which
        a tape measures chest, waist, hip and thigh.
    """
    rest = np.asarray(body.rest_vertices(body.default_shape()), dtype=np.float64)
    rows, faces = split_quads(np.asarray(body.tights_quads), len(rest))
    points = rows @ rest
    mean = smoothing_matrix(faces, len(points))
    mirror = np.asarray(KDTree(points).query(points * [-1, 1, 1])[1])
    carrier = points
    for _ in range(CARRIER_PASSES):
        carrier = mean @ carrier
    carrier = 0.5 * (carrier + carrier[mirror] * [-1, 1, 1])
    fields = _fields(body, rest, rows, carrier, faces, mean, mirror)
    front = _frontness(body, rest, rows, mean, mirror)
    pieces, piece_faces, _ = cut(
        sp.csr_matrix(sp.identity(len(points))), faces, _ANKLE - points[:, 1]
    )
    pieces, piece_faces, _ = cut(pieces, piece_faces, -(pieces @ points)[:, 0])
    arrays: dict[str, np.ndarray] = {}
    outlines = {}
    for name, sign in (("front", -1.0), ("back", 1.0)):
        part, tri, _ = cut(pieces, piece_faces, np.asarray(sign * (pieces @ front)))
        if name == "back":
            tri = tri[:, [0, 2, 1]]
        where = part @ carrier
        centre = np.flatnonzero(np.abs((part @ points)[:, 0]) < 1e-9)
        # The crotch is a saddle: its middle must bend, as trousers' patterns do.
        straight = centre[where[centre, 1] > _STRAIGHT]
        uv = flatten(where, tri, where[:, :2], on_axis=straight, steps=400)
        # Heights of the pattern start at the body's own.
        uv[:, 1] += where[centre, 1].max() - uv[centre, 1].max()
        for key, value in _grid(uv, tri, where, carrier, faces, fields).items():
            arrays[f"{name}_{key}"] = value
        loop = boundary_loops(tri)[0]
        if name == "back":
            loop = loop[::-1]
        outlines[name] = (loop, uv, part @ points)
    return arrays | _seams(outlines) | skirt_grid(body, rest) | tapes(body, rest)


def _bones(body: Body, rest: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    ends = body.joint_positions(jnp.asarray(rest, jnp.float32))
    heads, tails = (np.array(x, dtype=np.float64) for x in ends)
    return heads, tails


def _frontness(
    body: Body, rest: np.ndarray, rows: sp.csr_matrix, mean: sp.csr_matrix, mirror: np.ndarray
) -> Float[np.ndarray, " vertices"]:
    """How far a point lies before the bones that it follows [m]; side seams are where it is 0."""
    heads, tails = _bones(body, rest)
    for name in _TORSO:
        heads[body.joint(name), 2] = tails[body.joint(name), 2] = _TORSO_DEPTH
    points = rows @ rest
    bone = tails - heads
    along = ((points[:, None] - heads) * bone).sum(axis=2) / np.maximum((bone**2).sum(axis=1), 1e-9)
    depth = heads[:, 2] + np.clip(along, 0.0, 1.0) * bone[:, 2]
    weights = rows @ np.asarray(body.weights, dtype=np.float64)
    front = points[:, 2] - (weights * depth).sum(axis=1) / weights.sum(axis=1)
    for _ in range(_SEAM_PASSES):
        front = mean @ front
    return 0.5 * (front + front[mirror])


def _fields(
    body: Body,
    rest: np.ndarray,
    rows: sp.csr_matrix,
    carrier: np.ndarray,
    faces: np.ndarray,
    mean: sp.csr_matrix,
    mirror: np.ndarray,
) -> Float[np.ndarray, "vertices 4"]:
    """Height, distance along the arm, share of the arm, free distance."""
    heads, tails = _bones(body, rest)
    weights = rows @ np.asarray(body.weights, dtype=np.float64)
    arm = [body.joint(f"Left{n}") for n in ("Arm", "ForeArm", "Hand")]
    points = rows @ rest
    left = np.where((points[:, 0] < 0)[:, None], points * [-1, 1, 1], points)
    length = np.linalg.norm(tails - heads, axis=1)
    before, parts, total = 0.0, [], []
    for j in arm:
        bone = (tails[j] - heads[j]) / length[j]
        own = np.maximum(weights[:, j], weights[mirror, j])
        parts.append(own * (before + (left - heads[j]) @ bone))
        total.append(own)
        before += length[j]
    share = np.sum(total, axis=0)
    shoulder = body.joint("LeftArm")
    bone = (tails[shoulder] - heads[shoulder]) / length[shoulder]
    straight = (left - heads[shoulder]) @ bone
    mixed = np.sum(parts, axis=0) / np.maximum(share, 1e-6)
    # Near the shoulder the cut of an armhole is upright; along the arm it is square to the bone.
    upright = (left[:, 0] - heads[shoulder, 0]) / bone[0]
    turn = np.clip(straight / 0.12, 0.0, 1.0)
    turn = turn**2 * (3 - 2 * turn)
    reach = (1 - turn) * upright + turn * np.where(share > 0.3, mixed, straight)
    free = _free_distance(carrier, faces)
    # Smoothing must not raise the least.
    for _ in range(_LEAST_PASSES):
        free = _least_around(free, mean)
    out = np.column_stack([carrier[:, 1], reach, share, free])
    for _ in range(_SHARE_PASSES):
        out[:, 1:] = mean @ out[:, 1:]
    return 0.5 * (out + out[mirror])


def _free_distance(carrier: np.ndarray, faces: np.ndarray) -> Float[np.ndarray, " vertices"]:
    """How far the surface can be moved outwards before it meets itself [m].

    The radius of the largest ball that touches a vertex from outside and holds no other.

    References:
        Ma, Bae and Choi, 3D medial axis point approximation using nearest neighbors and the normal
        field (2012).
    """
    normals = vertex_normals(np.asarray(carrier), np.asarray(faces))
    out = np.empty(len(carrier))
    for i, (p, n) in enumerate(zip(carrier, normals)):
        away = carrier - p
        squared = (away**2).sum(axis=1)
        ahead = away @ n
        other = (squared > _NEAREST**2) & (ahead > 1e-6)
        out[i] = (squared[other] / (2 * ahead[other])).min(initial=_FARTHEST)
    return out


def _least_around(values: Float[np.ndarray, " vertices"], mean: sp.csr_matrix) -> np.ndarray:
    """The least value of each vertex and its neighbours."""
    pairs = mean.tocoo()
    out = values.copy()
    np.minimum.at(out, pairs.row, values[pairs.col])
    return out


def _grid(
    uv: Float[np.ndarray, "vertices 2"],
    tri: Int[np.ndarray, "pieces 3"],
    where: Float[np.ndarray, "vertices 3"],
    carrier: Float[np.ndarray, "tights 3"],
    faces: Int[np.ndarray, "faces 3"],
    fields: Float[np.ndarray, "tights 4"],
) -> dict[str, np.ndarray]:
    """Points of the tights at the nodes of a grid over a chart; beyond its border, by extension."""
    low = np.floor(uv.min(axis=0) / SPACING) - BEYOND
    size = (np.ceil(uv.max(axis=0) / SPACING) + BEYOND - low).astype(int) + 1
    x, y = np.meshgrid(*(SPACING * (low[k] + np.arange(size[k])) for k in range(2)))
    nodes = np.column_stack([x.ravel(), y.ravel()])
    nearest, share = nearest_triangle(nodes, uv, tri)
    # Each piece of the chart lies in one triangle of the tights: the one its centre is nearest to.
    mesh = make_mesh(carrier, faces)
    centres = where[tri].mean(axis=1)
    owner = np.asarray(closest_points(mesh, centres.astype(np.float32)).face)
    spot = np.einsum("nk,nkc->nc", share, where[tri[nearest]])
    corner = faces[owner[nearest]]
    weight = _affine(spot, carrier[corner])
    inside = share.min(axis=1) > -1e-3
    weight = np.where(inside[:, None], weight, [1.0, 0.0, 0.0])
    shape = (size[1], size[0])
    values = np.einsum("nk,nkc->nc", weight, fields[corner])
    # Heights and distances go on beyond the border, shares and free distances keep their value.
    for target, near, far, part in extension(inside.reshape(shape)):
        beyond = 2 * values[near] - values[far]
        beyond[..., 2:] = values[near][..., 2:]
        values[target] = (part[..., None] * beyond).sum(axis=1)
    return {
        "origin": SPACING * low,
        "refs": corner.reshape(*shape, 3).astype(np.uint16),
        "weights": weight.reshape(*shape, 3).astype(np.float32),
        "fields": values.reshape(*shape, -1).astype(np.float32),
        "inside": inside.reshape(shape),
    }


def _affine(
    spot: Float[np.ndarray, "nodes 3"], corner: Float[np.ndarray, "nodes 3 3"]
) -> Float[np.ndarray, "nodes 3"]:
    """Weights of three corners that give a point of their plane."""
    e, f, d = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0], spot - corner[:, 0]
    ee, ef, ff = (e * e).sum(axis=1), (e * f).sum(axis=1), (f * f).sum(axis=1)
    de, df = (d * e).sum(axis=1), (d * f).sum(axis=1)
    det = ee * ff - ef**2
    s, t = (ff * de - ef * df) / det, (ee * df - ef * de) / det
    return np.column_stack([1 - s - t, s, t])


def _seams(outlines: dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]) -> dict[str, np.ndarray]:
    """The curves where front and back meet, as rows (u, v of the front, u, v of the back)."""
    loop, uv, points = outlines["front"]
    other_loop, other_uv, other_points = outlines["back"]
    distance, match = KDTree(other_points[other_loop]).query(points[loop])
    shared = distance < 1e-9
    both = np.column_stack([uv[loop], other_uv[other_loop][match]])
    p = points[loop]
    centre = np.abs(p[:, 0]) < 1e-9
    crotch = int(np.argmin(np.where(centre, p[:, 1], np.inf)))
    # From the crotch on, the loop runs down the inner leg, up the side, out to the wrist and back.
    order = np.roll(np.arange(len(loop)), -crotch)
    if not shared[order[1]]:
        order = np.roll(order[::-1], 1)
    y, x = p[order, 1], p[order, 0]
    ankle = np.flatnonzero(y < _ANKLE + 0.006)
    wrist = np.flatnonzero(x > 0.98 * x.max() - 0.03)
    high = np.flatnonzero(centre[order])
    neck = len(order) - len(high)
    runs = {
        "inseam": range(0, int(ankle[0]) + 1),
        "side": range(int(ankle[-1]), int(wrist[0]) + 1),
        "over": range(int(wrist[-1]), neck),
    }
    out: dict[str, np.ndarray] = {}
    for name, (ring, chart, spots) in outlines.items():
        middle = ring[np.abs(spots[ring][:, 0]) < 1e-9]
        # Down the front or the back, and under the crotch to where both meet.
        middle = middle[np.argsort(-chart[middle, 1])]
        out[f"middle_{name}"] = chart[middle]
    for name, run in runs.items():
        index = order[[k for k in run if shared[order[k]]]]
        out[name] = both[index]
    return out
