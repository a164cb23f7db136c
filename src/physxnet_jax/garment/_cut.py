"""Cuts meshes along level sets; every new vertex is a convex combination of old ones."""

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Int

# Vertices this close to the cut (fraction of an edge) snap to it, which avoids slivers.
_SNAP = 0.35


def split_quads(
    quads: Int[np.ndarray, "quads 4"], num_vertices: int
) -> tuple[sp.csr_matrix, Int[np.ndarray, "faces 3"]]:
    """Splits each quad into four triangles around its centre; no diagonal is preferred.

    Args:
        quads: Vertex indices.
        num_vertices: Number of vertices that they index.

    Returns:
        A matrix of convex combinations, one row per new vertex (used old vertices, then
        centres), and triangles over its rows.
    """
    used = np.unique(quads)
    local = np.full(num_vertices, -1)
    local[used] = np.arange(len(used))
    q = local[quads]
    corners = sp.csr_matrix(
        (np.ones(len(used)), (np.arange(len(used)), used)), (len(used), num_vertices)
    )
    rows = np.repeat(np.arange(len(q)), 4)
    centres = sp.csr_matrix(
        (np.full(4 * len(q), 0.25), (rows, quads.ravel())), (len(q), num_vertices)
    )
    middle = len(used) + np.arange(len(q))
    faces = np.concatenate(
        [np.column_stack([q[:, k], q[:, (k + 1) % 4], middle]) for k in range(4)]
    )
    return sp.csr_matrix(sp.vstack([corners, centres])), faces


def cut(
    rows: sp.csr_matrix,
    faces: Int[np.ndarray, "faces 3"],
    field: Float[np.ndarray, " vertices"],
) -> tuple[sp.csr_matrix, Int[np.ndarray, "pieces 3"], Int[np.ndarray, " kept"]]:
    """Keeps the part of a mesh where a field is negative, with its border on the zero level.

    Vertices close to the level snap to it along the edge whose crossing is nearest, as a
    fraction of the edge. Edges that still cross the level get a new vertex on it.

    Args:
        rows: Convex combinations that define the vertices, one row each.
        faces: Triangles.
        field: Value at each vertex; linear along edges.

    Returns:
        Rows and triangles of the kept part, and the old index of each of its vertices, -1
        for new ones.
    """
    f = np.asarray(field, dtype=np.float64).copy()
    edges = np.unique(
        np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])),
        axis=0,
    )
    table = rows.tolil()
    base = sp.csr_matrix(rows)
    crossing = edges[f[edges[:, 0]] * f[edges[:, 1]] < 0]
    best = np.full(len(f), _SNAP)
    partner = np.full(len(f), -1)
    for a, b in np.concatenate([crossing, crossing[:, ::-1]]):
        t = f[a] / (f[a] - f[b])
        if t < best[a]:
            best[a], partner[a] = t, b
    for a in np.flatnonzero(partner >= 0):
        table[a] = (1 - best[a]) * base[a] + best[a] * base[partner[a]]
    f[partner >= 0] = 0.0
    base = sp.csr_matrix(table)
    extra: dict[tuple[int, int], int] = {}
    mixed: list[sp.csr_matrix] = []

    def middle(a: int, b: int) -> int:
        key = (min(a, b), max(a, b))
        if key not in extra:
            t = f[a] / (f[a] - f[b])
            extra[key] = len(f) + len(mixed)
            mixed.append((1 - t) * base[a] + t * base[b])
        return extra[key]

    kept: list[tuple[int, int, int]] = []
    for tri in faces:
        polygon: list[int] = []
        for k in range(3):
            a, b = int(tri[k]), int(tri[(k + 1) % 3])
            if f[a] <= 0:
                polygon.append(a)
            if f[a] * f[b] < 0:
                polygon.append(middle(a, b))
        if len(polygon) >= 3 and any(f[v] < 0 for v in polygon if v < len(f)):
            kept += [(polygon[0], polygon[k], polygon[k + 1]) for k in range(1, len(polygon) - 1)]
    out = np.asarray(kept)
    used = np.unique(out)
    remap = np.full(len(f) + len(mixed), -1)
    remap[used] = np.arange(len(used))
    stacked = sp.csr_matrix(sp.vstack([base, *mixed]))
    origin = np.where(used < len(f), used, -1)
    picked: sp.csr_matrix = stacked[used]  # pyright: ignore[reportOptionalSubscript, reportAssignmentType]
    return picked, remap[out], origin


def refine(
    rows: sp.csr_matrix,
    faces: Int[np.ndarray, "faces 3"],
    rest: Float[np.ndarray, "all 3"],
    max_edge: float,
) -> tuple[sp.csr_matrix, Int[np.ndarray, "pieces 3"]]:
    """Bisects edges longer than a limit, the longest of each face first.

    Args:
        rows: Convex combinations that define the vertices, one row each.
        faces: Triangles.
        rest: Positions that the rows combine [m].
        max_edge: Longest edge allowed [m].

    Returns:
        Rows and triangles; new vertices are edge midpoints and come last.

    References:
        Rivara, Mesh refinement by longest edge bisection (1984).
    """
    faces = np.asarray(faces).copy()
    while True:
        p = rows @ rest
        sides = np.stack([faces[:, [1, 2]], faces[:, [2, 0]], faces[:, [0, 1]]], axis=1)
        length = np.linalg.norm(p[sides[:, :, 0]] - p[sides[:, :, 1]], axis=2)
        longest = np.argmax(length, axis=1)
        lane = np.arange(len(faces))
        key = np.sort(sides[lane, longest], axis=1)
        long = length[lane, longest] > max_edge
        if not long.any():
            return rows, faces
        # An edge is bisected in this pass if it is the longest of every adjacent face.
        all_keys = np.sort(sides, axis=2).reshape(-1, 2)
        long_edges = np.unique(key[long], axis=0)
        edges, inverse = np.unique(all_keys, axis=0, return_inverse=True)
        inverse = inverse.reshape(-1, 3)
        beside = np.bincount(inverse.ravel(), minlength=len(edges))
        votes = np.bincount(inverse[lane, longest], minlength=len(edges))
        consistent = {tuple(e) for e in edges[beside == votes]}
        chosen = [tuple(e) for e in long_edges if tuple(e) in consistent]
        if not chosen:
            # Only ties get here: the longest edge of all is the longest of each of its faces.
            flat = length[lane, longest]
            chosen = [tuple(key[int(np.argmax(np.where(long, flat, 0)))])]
        table = {e: len(p) + k for k, e in enumerate(chosen)}
        ends = np.asarray(chosen)
        rows = sp.csr_matrix(sp.vstack([rows, 0.5 * (rows[ends[:, 0]] + rows[ends[:, 1]])]))
        out = []
        for tri in faces:
            for k in range(3):
                a, b, c = int(tri[k]), int(tri[(k + 1) % 3]), int(tri[(k + 2) % 3])
                m = table.get((min(a, b), max(a, b)))
                if m is not None:
                    out += [(a, m, c), (m, b, c)]
                    break
            else:
                out.append(tuple(int(x) for x in tri))
        faces = np.asarray(out)
