"""The three template garments, cut and welded from the body's helper geometry."""

import dataclasses
import functools
import importlib.resources

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Int

from ..body import Body, load_body
from ..errors import MeshError
from ..geometry import TriMesh, boundary_loops, cast_rays, make_mesh, pad_rows, vertex_normals
from ._cut import cut, refine, split_quads
from ._fit import (
    bridge_hollows,
    clearance,
    level_hem,
    lift_out,
    lift_over,
    relax_crossings,
    set_clearance,
)
from ._garment import COTTON, TEMPLATES, Fabric, Garment, Template, carried_weights

# Heights on the default shape [m]; y = 0 lies in the pelvis.
_WAIST = 0.10
_HEM_TOP = -0.03
_ANKLE = -0.70
_NECK = 0.535
_DRESS_WAIST = 0.115
_DRESS_NECK = 0.533
_DRESS_HEM = -0.45
_SHORT_SLEEVE = 0.5
_SKIRT_ROW = 0.021
_MAX_EDGE = 0.031
_FARTHEST = 0.019
# Clearance of a levelled hem [m].
_HEM_GAP = 0.0065
# Height of the top over the trousers where they overlap [m].
_OVER_TROUSERS = 0.005
ASSET = "templates_cc0.npz"


@dataclasses.dataclass(frozen=True)
class _Cut:
    rows: sp.csr_matrix
    faces: Int[np.ndarray, "faces 3"]


def build_template(name: Template, body: Body | None = None) -> Garment:
    """Builds a template from the helper tights and skirt, in about ten seconds.

    `template` loads the same garment from the package.

    Args:
        name: ``top`` (long sleeves), ``bottom`` (trousers) or ``dress`` (short
            sleeves, welded to a skirt below the knee).
        body: The body; the built-in one by default.

    Returns:
        The garment on the default shape, 5 to 20 mm clear of the skin (the skirt
        hangs free), with texture coordinates.

    Raises:
        MeshError: The name is unknown.
    """
    body = load_body() if body is None else body
    rest = np.asarray(body.rest_vertices(body.default_shape()), dtype=np.float64)
    rows, faces = split_quads(np.asarray(body.tights_quads), len(rest))
    if name == "top":
        piece = _keep(rows, faces, rest, lambda p: _HEM_TOP - p[:, 1])
        piece = _keep(piece.rows, piece.faces, rest, lambda p: _neck(p, 0.3) - _NECK)
        fabric = dataclasses.replace(COTTON, thickness=0.008)
    elif name == "bottom":
        piece = _keep(rows, faces, rest, lambda p: p[:, 1] - _WAIST)
        piece = _keep(piece.rows, piece.faces, rest, lambda p: _ANKLE - p[:, 1])
        fabric = COTTON
    elif name == "dress":
        piece = _keep(rows, faces, rest, lambda p: _DRESS_WAIST - p[:, 1], body=body)
        piece = _keep(piece.rows, piece.faces, rest, lambda p: _neck(p, 0.4) - _DRESS_NECK)
        piece = _short_sleeves(piece, rest, body)
        piece = _weld_skirt(piece, rest, body)
        fabric = COTTON
    else:
        raise MeshError(f"No template '{name}'; there are {', '.join(TEMPLATES)}.")
    piece = _Cut(*refine(piece.rows, piece.faces, rest, _MAX_EDGE))
    start = piece.rows @ rest
    mesh = body.rest_mesh()
    target, free = _targets(name, start, piece.faces)
    vertices = set_clearance(mesh, start, piece.faces, target, free=free)
    vertices = bridge_hollows(mesh, vertices, piece.faces, farthest=_FARTHEST)
    vertices = relax_crossings(mesh, vertices, piece.faces)
    if name == "top":
        # Spanning the hollow of the back pulled the hem up.
        vertices = _level_top_hem(mesh, vertices, piece.faces)
        # Both garments hug the skin where their hems overlap, and the top is the outer one.
        under = build_template("bottom", body).mesh
        vertices = lift_over(under, vertices, piece.faces, _OVER_TROUSERS)
    pinned = np.zeros(len(vertices), dtype=bool)
    if name == "bottom":
        loops = boundary_loops(piece.faces)
        waist = max(loops, key=lambda loop: vertices[loop, 1].mean())
        pinned[waist] = True
    return _assemble(name, piece, vertices, vertices - start, pinned, fabric, body)


def _level_top_hem(
    skin: TriMesh, vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> Float[np.ndarray, "vertices 3"]:
    """Levels a top's hem, within the clearance that the rest of it has."""
    level = level_hem(vertices, faces, _HEM_TOP)
    lowered = np.abs(level - vertices).max(axis=1) > 1e-4
    clear, _ = lift_out(skin, level, faces, _HEM_GAP, iterations=12)
    out = np.where(lowered[:, None], clear, vertices)
    distance, away = clearance(skin, out)
    return out - np.where(lowered, np.maximum(distance - _FARTHEST, 0.0), 0.0)[:, None] * away


@functools.cache
def template(name: Template) -> Garment:
    """Loads a template garment from the package, see `build_template`.

    Args:
        name: ``top``, ``bottom`` or ``dress``.

    Returns:
        The garment at rest on the built-in body's default shape.

    Raises:
        MeshError: The name is unknown.

    Example:
        >>> template("bottom").mesh.vertices.shape[1]
        3
    """
    if name not in TEMPLATES:
        raise MeshError(f"No template '{name}'; there are {', '.join(TEMPLATES)}.")
    resource = importlib.resources.files(__name__.rpartition(".")[0]) / "assets" / ASSET
    with importlib.resources.as_file(resource) as path, np.load(path) as data:
        part = {k: data[f"{name}_{k}"] for k in _STORED}
    # Cached arrays must not be tracers of a surrounding transformation.
    with jax.ensure_compile_time_eval():
        return _from_arrays(name, part)


def _from_arrays(name: Template, part: dict[str, np.ndarray]) -> Garment:
    fabric = Fabric(*(float(x) for x in part["fabric"]))
    mesh = make_mesh(part["vertices"], part["faces"], part["uv"], name=name)
    refs = jax.device_put(part["refs"].astype(np.int32))
    weights = jax.device_put(part["ref_weights"])
    return Garment(
        mesh,
        jax.device_put(part["pinned"]),
        refs,
        weights,
        jax.device_put(part["offset"]),
        carried_weights(load_body().weights, refs, weights),
        fabric,
        name,
        name,
    )


_STORED = (
    "vertices",
    "faces",
    "uv",
    "pinned",
    "refs",
    "ref_weights",
    "offset",
    "fabric",
)


def stored_arrays(garment: Garment) -> dict[str, np.ndarray]:
    """Arrays of a template that the asset stores."""
    values = {
        "vertices": garment.mesh.vertices,
        "faces": np.asarray(garment.mesh.faces).astype(np.uint16),
        "uv": garment.mesh.uv,
        "pinned": garment.pinned,
        "refs": np.asarray(garment.refs).astype(np.uint16),
        "ref_weights": garment.ref_weights,
        "offset": garment.offset,
        "fabric": np.asarray(dataclasses.astuple(garment.fabric)[:5], np.float64),
    }
    return {f"{garment.name}_{k}": np.asarray(v) for k, v in values.items()}


def _assemble(
    name: Template,
    piece: _Cut,
    vertices: Float[np.ndarray, "vertices 3"],
    offset: Float[np.ndarray, "vertices 3"],
    pinned: np.ndarray,
    fabric: Fabric,
    body: Body,
) -> Garment:
    index, weight = pad_rows(piece.rows)
    mesh = make_mesh(vertices, piece.faces, _cylinder_uv(vertices), name=name)
    return Garment(
        mesh,
        jax.device_put(pinned),
        jax.device_put(index),
        jax.device_put(weight),
        jax.device_put(offset.astype(np.float32)),
        carried_weights(body.weights, jax.device_put(index), jax.device_put(weight)),
        fabric,
        name,
        name,
    )


def _cylinder_uv(p: Float[np.ndarray, "vertices 3"]) -> Float[np.ndarray, "vertices 2"]:
    """Projects front and back side by side: sufficient for patterns, not for prints."""
    low, high = p.min(axis=0), p.max(axis=0)
    size = np.maximum(high - low, 1e-6)
    q = (p - low) / size
    front = p[:, 2] > np.median(p[:, 2])
    return np.column_stack([0.5 * q[:, 0] + np.where(front, 0.0, 0.5), q[:, 1]])


def _neck(p: Float[np.ndarray, "vertices 3"], slope: float) -> np.ndarray:
    """Height relative to a plane that slopes down towards the chest [m]."""
    return p[:, 1] + slope * p[:, 2]


def _keep(
    rows: sp.csr_matrix, faces: np.ndarray, rest: np.ndarray, field, body: Body | None = None
) -> _Cut:
    """Keeps the part where the field is negative, and the arms of the body if one is given."""
    p = rows @ rest
    value = field(p)
    if body is not None:
        value = np.where(_arm_share(rows, body) > 0.5, -1.0, value)
    part, tri, _ = cut(rows, faces, value)
    return _Cut(part, tri)


def _arm_share(rows: sp.csr_matrix, body: Body) -> np.ndarray:
    names = [f"{s}{n}" for s in ("Left", "Right") for n in ("Arm", "ForeArm", "Hand")]
    weights = np.asarray(body.weights, dtype=np.float64)
    return rows @ weights[:, [body.joint(n) for n in names]].sum(axis=1)


def _short_sleeves(piece: _Cut, rest: np.ndarray, body: Body) -> _Cut:
    heads, tails = (np.asarray(x) for x in body.joint_positions(jnp.asarray(rest, jnp.float32)))
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        j = body.joint(f"{side}Arm")
        bone = tails[j] - heads[j]
        p = piece.rows @ rest
        along = (p - heads[j]) @ bone / (bone @ bone) - _SHORT_SLEEVE
        on_arm = (_arm_share(piece.rows, body) > 0.3) & (sign * p[:, 0] > 0)
        part, tri, _ = cut(piece.rows, piece.faces, np.where(on_arm, along, -1.0))
        piece = _Cut(part, tri)
    return piece


def _weld_skirt(piece: _Cut, rest: np.ndarray, body: Body) -> _Cut:
    """Extends the torso's lower border with a skirt, one column per border vertex."""
    p = piece.rows @ rest
    loops = boundary_loops(piece.faces)
    loop = min(loops, key=lambda x: p[x, 1].mean())
    rings = _skirt_rings(np.asarray(body.skirt_quads), rest)
    centre = rest[rings[0]].mean(axis=0)
    angle = np.arctan2(p[loop, 0] - centre[0], p[loop, 2] - centre[2])
    ring_points = np.stack([_at_angles(ring, angle, rest)[1] for ring in rings])
    ring_rows = [_at_angles(ring, angle, rest)[0] for ring in rings]
    steps = round((p[loop, 1].mean() - _DRESS_HEM) / _SKIRT_ROW)
    first = p[loop, 1]
    blocks: list[sp.csr_matrix] = []
    for s in range(1, steps + 1):
        height = first + (s / steps) * (_DRESS_HEM - first)
        # Near the weld, columns blend from the torso into the helper skirt.
        fade = min(1.0, s / 4.0)
        lines = []
        for k in range(len(loop)):
            y = ring_points[:, k, 1]
            upper = int(np.clip(np.searchsorted(-y, -height[k]) - 1, 0, len(rings) - 2))
            t = np.clip((y[upper] - height[k]) / (y[upper] - y[upper + 1]), 0.0, 1.0)
            target = (1 - t) * ring_rows[upper][k] + t * ring_rows[upper + 1][k]
            if fade < 1.0:
                start = piece.rows[loop[k]]
                fourth = first[k] + (4 / steps) * (_DRESS_HEM - first[k])
                u4 = int(np.clip(np.searchsorted(-y, -fourth) - 1, 0, len(rings) - 2))
                w4 = np.clip((y[u4] - fourth) / (y[u4] - y[u4 + 1]), 0.0, 1.0)
                end = (1 - w4) * ring_rows[u4][k] + w4 * ring_rows[u4 + 1][k]
                target = (1 - fade) * start + fade * end
            lines.append(target)
        blocks.append(sp.csr_matrix(sp.vstack(lines)))
    n, c = len(p), len(loop)
    table = np.concatenate([loop[None], n + np.arange(steps * c).reshape(steps, c)])
    faces = [piece.faces]
    for s in range(steps):
        a, b = table[s], np.roll(table[s], -1)
        d, e = table[s + 1], np.roll(table[s + 1], -1)
        odd = (np.arange(c) + s) % 2 == 0
        # Boundary loops follow the half edges of their faces; skirt faces use the opposite ones.
        one = np.where(odd[:, None], np.column_stack([b, a, d]), np.column_stack([b, a, e]))
        two = np.where(odd[:, None], np.column_stack([b, d, e]), np.column_stack([a, d, e]))
        faces += [one, two]
    rows = sp.csr_matrix(sp.vstack([piece.rows, *blocks]))
    return _Cut(rows, np.concatenate(faces))


def _skirt_rings(
    quads: Int[np.ndarray, "quads 4"], rest: np.ndarray
) -> list[Int[np.ndarray, " ring"]]:
    """Rings of the helper skirt from the waist down."""
    tri = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    top = max(boundary_loops(tri), key=lambda x: rest[x, 1].mean())
    rings = [np.asarray(top)]
    seen = set(top.tolist())
    while True:
        touching = np.isin(quads, rings[-1]).any(axis=1)
        following = np.setdiff1d(np.unique(quads[touching]), np.asarray(sorted(seen)))
        if len(following) == 0:
            return rings
        rings.append(following)
        seen |= set(following.tolist())


def _at_angles(
    ring: Int[np.ndarray, " ring"], angle: np.ndarray, rest: np.ndarray
) -> tuple[sp.csr_matrix, np.ndarray]:
    """Points of a ring at given angles about its centre: combination rows and positions."""
    centre = rest[ring].mean(axis=0)
    ring_angles = np.arctan2(rest[ring, 0] - centre[0], rest[ring, 2] - centre[2])
    order = np.argsort(ring_angles)
    ring, ring_angles = ring[order], ring_angles[order]
    after = np.searchsorted(ring_angles, angle) % len(ring)
    before = (after - 1) % len(ring)
    span = np.mod(ring_angles[after] - ring_angles[before], 2 * np.pi)
    t = np.mod(angle - ring_angles[before], 2 * np.pi) / span
    lines = np.arange(len(angle))
    rows = sp.csr_matrix(
        (
            np.concatenate([1 - t, t]),
            (np.concatenate([lines, lines]), np.concatenate([ring[before], ring[after]])),
        ),
        (len(angle), len(rest)),
    )
    return rows, rows @ rest


def _targets(name: Template, p: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Target clearance [m], and where the cloth may be farther from the skin."""
    free = np.zeros(len(p))
    if name == "top":
        target = np.interp(p[:, 1], [_HEM_TOP, 0.25, 0.45], [0.017, 0.014, 0.011])
    elif name == "bottom":
        target = np.interp(p[:, 1], [_ANKLE, -0.3, 0.0, _WAIST], [0.017, 0.014, 0.009, 0.007])
    else:
        target = np.interp(p[:, 1], [_DRESS_HEM, 0.0, 0.3, 0.45], [0.012, 0.010, 0.009, 0.009])
        free = (p[:, 1] < _DRESS_WAIST).astype(float)
    free_distance = _free_distance(p, faces)
    return np.minimum(target, np.maximum(0.3 * free_distance, 0.0065)), free


def _free_distance(p: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Distance to the garment itself along its outward normals [m]."""
    mesh: TriMesh = make_mesh(p, faces)
    normals = vertex_normals(mesh.vertices, mesh.faces)
    hits = cast_rays(mesh, mesh.vertices + 0.002 * normals, normals, max_distance=0.2)
    return np.where(np.asarray(hits.valid), np.asarray(hits.distance) + 0.002, 1.0)
