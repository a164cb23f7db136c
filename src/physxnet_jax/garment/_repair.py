"""Mesh repair for cloth: welding, cleaning, orienting and subdividing.

Every function keeps texture coordinates with their corners.
"""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components as components
from scipy.spatial import KDTree

from ..errors import MeshError
from ..geometry import (
    Polygons,
    TriMesh,
    boundary_loops,
    connected_components,
    make_mesh,
    manifold_report,
    mesh_edges,
)
from ._fit import clearance

WELD = 1e-4
"""Vertices closer than this are merged [m]."""

_MIN_AREA = 1e-10
_MAX_VERTICES = 400_000
_MAX_PAIRS = 20_000_000


@dataclasses.dataclass(frozen=True)
class MeshHealth:
    """Statistics and common defects of a mesh.

    Attributes:
        vertices: Number of vertices that a face uses.
        faces: Number of triangles.
        components: Number of connected parts.
        openings: Length of each boundary [m], longest first.
        non_manifold_edges: Edges with more than two faces.
        duplicate_faces: Faces that occur more than once.
        degenerate_faces: Faces of zero area.
        inconsistent_edges: Edges whose faces have inconsistent winding.
        unused_vertices: Vertices that no face uses.
        coincident_vertices: Vertices within `WELD` of another one.
        median_edge: Median length of edges [m].
        longest_edge: Length of the longest edge [m].
        uv: Whether there are texture coordinates.
    """

    vertices: int
    faces: int
    components: int
    openings: tuple[float, ...]
    non_manifold_edges: int
    duplicate_faces: int
    degenerate_faces: int
    inconsistent_edges: int
    unused_vertices: int
    coincident_vertices: int
    median_edge: float
    longest_edge: float
    uv: bool


def mesh_health(mesh: TriMesh) -> MeshHealth:
    """Computes the statistics of a mesh in metres."""
    x, faces = _arrays(mesh)
    used = np.unique(faces)
    report = manifold_report(faces)
    edges = mesh_edges(faces).vertices
    length = np.linalg.norm(x[edges[:, 0]] - x[edges[:, 1]], axis=1)
    labels = connected_components(faces, len(x))[used]
    lengths = [
        np.linalg.norm(x[loop] - x[np.roll(loop, 1)], axis=1) for loop in boundary_loops(faces)
    ]
    return MeshHealth(
        len(used),
        len(faces),
        len(np.unique(labels)),
        tuple(sorted((float(a.sum()) for a in lengths), reverse=True)),
        report["non_manifold_edges"],
        report["duplicate_faces"],
        int((~_has_area(x, faces)).sum()),
        report["inconsistent_edges"],
        len(x) - len(used),
        len(x) - int(_clusters(x, WELD).max(initial=-1)) - 1,
        float(np.median(length)),
        float(length.max()),
        mesh.uv is not None,
    )


def weld(mesh: TriMesh, distance: float = WELD) -> TriMesh:
    """Merges vertices within a distance of each other, at the position of the first.

    Args:
        mesh: The mesh.
        distance: Largest distance between merged neighbours [m].
    """
    x, faces = _arrays(mesh)
    label = _clusters(x, distance)
    _, first = np.unique(label, return_index=True)
    return _rebuild(mesh, x[first], label[faces])


def clean(mesh: TriMesh) -> TriMesh:
    """Removes faces of zero area, duplicate faces and unused vertices."""
    x, faces = _arrays(mesh)
    keep = _has_area(x, faces)
    _, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    once = np.zeros(len(faces), dtype=bool)
    once[first] = True
    keep &= once
    if not keep.any():
        raise MeshError("no face of this mesh has an area: export it again.")
    uv_faces = None if mesh.uv_faces is None else np.asarray(mesh.uv_faces)[keep]
    used, corners = np.unique(faces[keep], return_inverse=True)
    return _rebuild(mesh, x[used], corners.reshape(-1, 3), uv_faces)


def without_faults(
    x: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> tuple[Float[np.ndarray, "fewer 3"], Int[np.ndarray, "left 3"]]:
    """Welds vertices, and removes faces of zero area, duplicate faces and unused vertices."""
    label = _clusters(x, WELD)
    _, first = np.unique(label, return_index=True)
    x, faces = x[first], label[faces]
    faces = faces[_has_area(x, faces)]
    _, once = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    used, corners = np.unique(faces[np.sort(once)], return_inverse=True)
    return x[used], corners.reshape(-1, 3)


def orient(mesh: TriMesh, body: TriMesh) -> TriMesh:
    """Gives every connected part a consistent winding, outwards from the body.

    Args:
        mesh: A garment on the body.
        body: The closed body.
    """
    x, faces = _arrays(mesh)
    flip, part = _windings(faces)
    turned = np.where(flip[:, None], faces[:, ::-1], faces)
    corner = x[turned]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    _, away = clearance(body, corner.mean(axis=1).astype(np.float32))
    outward = np.bincount(part, np.einsum("fi,fi->f", normal, away))
    flipped = flip ^ (outward < 0)[part]
    uv_faces = None
    if mesh.uv_faces is not None:
        uv_faces = np.asarray(mesh.uv_faces)
        uv_faces = np.where(flipped[:, None], uv_faces[:, ::-1], uv_faces)
    out = np.where(flipped[:, None], faces[:, ::-1], faces)
    return _rebuild(mesh, x, out, uv_faces)


def subdivide(mesh: TriMesh, longest: float) -> tuple[TriMesh, Int[np.ndarray, " finer"]]:
    """Bisects edges until none is longer than a length [m]; shorter edges stay.

    Returns:
        The mesh, and for each of its faces the original face that it is a part of, shape
        [finer].

    Raises:
        MeshError: The result would have more than 400,000 vertices.
    """
    x, faces = _arrays(mesh)
    uv = None if mesh.uv is None else np.asarray(mesh.uv, np.float64)
    chart = None if mesh.uv_faces is None else np.asarray(mesh.uv_faces, np.int64)
    part_of = np.arange(len(faces))
    while True:
        edges = mesh_edges(faces)
        length = np.linalg.norm(x[edges.vertices[:, 0]] - x[edges.vertices[:, 1]], axis=1)
        long = length > longest
        if not long.any():
            return make_mesh(x, faces, uv, chart), part_of
        if len(x) + int(long.sum()) > _MAX_VERTICES:
            raise MeshError(
                f"edges of {1e3 * longest:g} mm would take over {_MAX_VERTICES:,} vertices: the"
                f" longest is {1e3 * length.max():.0f} mm. Choose a longer one."
            )
        split = long[edges.of_face]
        if uv is not None and chart is not None:
            uv, chart, _ = _split(uv, chart, split)
        x, faces, cut = _split(x, faces, split)
        part_of = part_of[cut]


def _split(
    x: Float[np.ndarray, "points d"],
    faces: Int[np.ndarray, "faces 3"],
    split: Bool[np.ndarray, "faces 3"],
) -> tuple[Float[np.ndarray, "more d"], Int[np.ndarray, "finer 3"], Int[np.ndarray, " finer"]]:
    """Splits triangles at the midpoints of selected edges; edge k is opposite corner k.

    Returns the points, the triangles, and the original triangle of each.
    """
    edges = mesh_edges(faces)
    chosen = np.zeros(len(edges.vertices), dtype=bool)
    chosen[edges.of_face[split]] = True
    number = np.full(len(chosen), -1)
    number[chosen] = len(x) + np.arange(chosen.sum())
    x = np.concatenate([x, x[edges.vertices[chosen]].mean(axis=1)])
    middle = number[edges.of_face]
    row = np.arange(len(faces))
    out, rows = [faces[~split.any(axis=1)]], [row[~split.any(axis=1)]]
    for k in range(3):
        # Corner c is followed by p and q; mc is the midpoint of p and q.
        turn = (k + np.arange(3)) % 3
        c, p, q = faces[:, turn].T
        mc, mp, mq = middle[:, turn].T
        one = split[:, turn[0]] & ~split[:, turn[1]] & ~split[:, turn[2]]
        out += [np.stack(t, 1)[one] for t in ((c, p, mc), (c, mc, q))]
        rows += [row[one]] * 2
        two = ~split[:, turn[0]] & split[:, turn[1]] & split[:, turn[2]]
        out += [np.stack(t, 1)[two] for t in ((c, mq, mp), (mq, p, q), (mq, q, mp))]
        rows += [row[two]] * 3
    every = split.all(axis=1)
    (a, b, c), (ma, mb, mc) = faces[every].T, middle[every].T
    out += [np.stack(t, 1) for t in ((a, mc, mb), (mc, b, ma), (mb, ma, c), (ma, mb, mc))]
    rows += [row[every]] * 4
    return x, np.concatenate(out), np.concatenate(rows)


def polygons_left(
    polygons: Polygons, vertices: Float[np.ndarray, "before 3"], mesh: TriMesh
) -> Polygons | None:
    """Maps polygons to a mesh that has been welded, cleaned and oriented since.

    Args:
        polygons: The polygons before these steps.
        vertices: The vertices before, at the same positions [m].
        mesh: The mesh after these steps.

    Returns:
        The remaining polygons, with the winding of their triangles; None if not every
        triangle is part of one.
    """
    x, faces = _arrays(mesh)
    far, row = (np.asarray(a) for a in KDTree(x).query(np.asarray(vertices, np.float64)))
    used = np.unique(polygons.corners)
    left = {tuple(sorted(f)): tuple(f) for f in faces.tolist()}
    keep, turned, count = [], [], 0
    for p, (start, n) in enumerate(zip(polygons.starts, polygons.counts, strict=True)):
        ring = row[polygons.corners[start : start + n]].tolist()
        # A quad may have been split along either diagonal.
        cuts = [ring, ring[1:] + ring[:1]] if n == 4 else [ring]
        for r in cuts:
            fan = [(r[0], r[k], r[k + 1]) for k in range(1, n - 1)]
            found = [left.get(tuple(sorted(f))) for f in fan]
            if len(set(ring)) == n and None not in found:
                keep.append(p)
                count += n - 2
                a, b, c = fan[0]
                if found[0] not in ((a, b, c), (b, c, a), (c, a, b)):
                    turned.append(len(keep) - 1)
                break
    if count != len(faces) or float(far[used].max()) > 2 * WELD:
        return None
    moved = polygons.chosen(keep).at(row)
    return None if moved is None else moved.reversed(turned)


def _arrays(
    mesh: TriMesh,
) -> tuple[Float[np.ndarray, "vertices 3"], Int[np.ndarray, "faces 3"]]:
    return np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)


def _rebuild(
    mesh: TriMesh, x: np.ndarray, faces: np.ndarray, uv_faces: np.ndarray | None = None
) -> TriMesh:
    """Rebuilds a mesh, keeping the texture coordinates of its corners."""
    if uv_faces is None and mesh.uv_faces is not None:
        uv_faces = np.asarray(mesh.uv_faces)
    uv = None if mesh.uv is None else np.asarray(mesh.uv)
    return make_mesh(x, faces, uv, uv_faces)


def _clusters(x: Float[np.ndarray, "vertices 3"], distance: float) -> Int[np.ndarray, " vertices"]:
    """Cluster of each vertex; clusters are numbered in the order of their first vertex."""
    # Only unique positions are paired: pairs of many coincident vertices would fill the memory.
    places, which = np.unique(x, axis=0, return_inverse=True)
    tree = KDTree(places)
    if tree.count_neighbors(tree, distance) > _MAX_PAIRS:
        raise MeshError(
            f"{len(x):,} vertices lie so close that most are within {1e3 * distance:g} mm of"
            " thousands of others. Export it in another unit, or decimate it first."
        )
    pairs = tree.query_pairs(distance, output_type="ndarray")
    ones = np.ones(len(pairs), dtype=np.int8)
    graph = coo_matrix((ones, (pairs[:, 0], pairs[:, 1])), (len(places), len(places)))
    label = components(graph, directed=False)[1][which.reshape(-1)]
    _, first, number = np.unique(label, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[number]


def _has_area(
    x: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> Bool[np.ndarray, " faces"]:
    return _areas(x, faces) > _MIN_AREA


def _areas(
    x: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> Float[np.ndarray, " faces"]:
    a, b, c = (x[faces[:, k]] for k in range(3))
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


def _windings(
    faces: Int[np.ndarray, "faces 3"],
) -> tuple[Bool[np.ndarray, " faces"], Int[np.ndarray, " faces"]]:
    """Faces to flip for a consistent winding, and the connected part of each face.

    Parts are connected by edges with two faces. The first face of a part isn't flipped.
    """
    edges = mesh_edges(faces)
    two = np.flatnonzero(edges.count == 2)
    pairs = edges.faces[two].astype(np.int64)
    # Neighbours have the same winding if they traverse their common edge in opposite directions.
    passes = [
        (faces[pairs[:, side]] == edges.vertices[two, :1]).argmax(axis=1) for side in range(2)
    ]
    after = [
        faces[pairs[:, side], (passes[side] + 1) % 3] == edges.vertices[two, 1] for side in range(2)
    ]
    differ = after[0] == after[1]
    count = len(faces)
    graph = coo_matrix((np.ones(len(two), np.int8), (pairs[:, 0], pairs[:, 1])), (count, count))
    flip = np.zeros(count, dtype=bool)
    keys = np.concatenate([pairs[:, 0] * count + pairs[:, 1], pairs[:, 1] * count + pairs[:, 0]])
    order = np.argsort(keys)
    keys, differ = keys[order], np.concatenate([differ, differ])[order]
    parts = components(graph, directed=False)[1]
    for start in np.unique(parts, return_index=True)[1]:
        walk, before = breadth_first_order(graph, start, directed=False)
        steps = walk[1:]
        turn = differ[np.searchsorted(keys, before[steps].astype(np.int64) * count + steps)]
        for face, turned in zip(steps, turn, strict=True):
            flip[face] = flip[before[face]] ^ turned
    return flip, parts
