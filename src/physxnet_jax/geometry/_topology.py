"""Connectivity of triangle meshes, on the host: edges, loops, rings, colours."""

import dataclasses
import functools

import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Int


@dataclasses.dataclass(frozen=True)
class Edges:
    """Unique edges of a triangle mesh.

    Attributes:
        vertices: End points, lower index first, shape [edges, 2].
        of_face: Edge opposite to corner k of a face, shape [faces, 3].
        faces: The two faces beside an edge, -1 for none, shape [edges, 2].
        count: Number of faces at an edge (1 boundary, 2 manifold), shape [edges].
    """

    vertices: Int[np.ndarray, "edges 2"]
    of_face: Int[np.ndarray, "faces 3"]
    faces: Int[np.ndarray, "edges 2"]
    count: Int[np.ndarray, " edges"]


def mesh_edges(faces: Int[np.ndarray, "faces 3"]) -> Edges:
    """Unique edges of a mesh and their adjacent faces; the arrays are read-only."""
    find = _cached_edges if len(faces) <= _MAX_CACHED_FACES else _mesh_edges
    return find(np.asarray(faces, dtype=np.int64).tobytes())


def _mesh_edges(faces: bytes) -> Edges:
    f = np.frombuffer(faces, dtype=np.int64).reshape(-1, 3)
    # Column k holds the edge opposite to corner k.
    halves = np.stack([f[:, [1, 2]], f[:, [2, 0]], f[:, [0, 1]]], axis=1)
    flat = np.sort(halves.reshape(-1, 2), axis=1)
    # One number per edge sorts many times as fast as pairs.
    size = int(f.max(initial=0)) + 1
    code, inverse = np.unique(flat[:, 0] * size + flat[:, 1], return_inverse=True)
    unique = np.stack([code // size, code % size], axis=1)
    inverse = inverse.reshape(-1)
    order = np.argsort(inverse, kind="stable")
    count = np.bincount(inverse, minlength=len(unique))
    start = np.cumsum(count) - count
    beside = np.full((len(unique), 2), -1, dtype=np.int64)
    beside[:, 0] = order[start] // 3
    two = count >= 2
    beside[two, 1] = order[start[two] + 1] // 3
    found = [x.astype(np.int32) for x in (unique, inverse.reshape(-1, 3), beside, count)]
    for x in found:
        x.flags.writeable = False
    return Edges(*found)


# The same few meshes are queried repeatedly; caching large ones would fill the memory.
_MAX_CACHED_FACES = 200_000
_cached_edges = functools.lru_cache(maxsize=8)(_mesh_edges)


def boundary_loops(faces: Int[np.ndarray, "faces 3"]) -> list[Int[np.ndarray, " n"]]:
    """Closed chains of boundary vertices, longest first.

    Each loop runs in the direction of its faces' half edges. A boundary that
    touches itself in a vertex is one loop that passes the vertex twice.
    """
    f = np.asarray(faces, dtype=np.int64)
    edges = mesh_edges(f)
    half = np.concatenate([f[:, [1, 2]], f[:, [2, 0]], f[:, [0, 1]]])
    key = edges.count[
        np.concatenate([edges.of_face[:, 0], edges.of_face[:, 1], edges.of_face[:, 2]])
    ]
    following: dict[int, list[int]] = {}
    for a, b in half[key == 1]:
        following.setdefault(int(a), []).append(int(b))
    loops = []
    while following:
        loop = _chain(next(iter(following)), following)
        k = 0
        while k < len(loop):
            # Other chains that begin and end at this vertex are inserted.
            if loop[k] in following:
                loop[k : k + 1] = [*_chain(loop[k], following), loop[k]]
            else:
                k += 1
        loops.append(np.asarray(loop, dtype=np.int32))
    return sorted(loops, key=len, reverse=True)


def _chain(start: int, following: dict[int, list[int]]) -> list[int]:
    """Follows edges until the chain closes; removes them from ``following``."""
    chain, at = [start], start
    while nexts := following.get(at):
        step = nexts.pop()
        if not nexts:
            del following[at]
        if step == start:
            break
        chain.append(step)
        at = step
    return chain


def connected_components(
    faces: Int[np.ndarray, "faces 3"], num_vertices: int
) -> Int[np.ndarray, " vertices"]:
    """Component label of every vertex (isolated vertices get one each)."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components as components

    f = np.asarray(faces)
    rows = np.concatenate([f[:, 0], f[:, 1]])
    cols = np.concatenate([f[:, 1], f[:, 2]])
    graph = coo_matrix(
        (np.ones(len(rows), dtype=np.int8), (rows, cols)),
        shape=(num_vertices, num_vertices),
    )
    return components(graph, directed=False)[1].astype(np.int32)


def vertex_faces(
    faces: Int[np.ndarray, "faces 3"], num_vertices: int
) -> Int[np.ndarray, "vertices degree"]:
    """Faces around every vertex, padded by repeating the first one.

    A vertex without a face gets face 0.
    """
    f = np.asarray(faces)
    flat = f.reshape(-1)
    order = np.argsort(flat, kind="stable")
    count = np.bincount(flat, minlength=num_vertices)
    start = np.concatenate([[0], np.cumsum(count)[:-1]])
    degree = max(int(count.max()), 1)
    slot = np.minimum(np.arange(degree)[None], np.maximum(count - 1, 0)[:, None])
    pick = np.minimum(start[:, None] + slot, len(order) - 1)
    table = order[pick] // 3
    table[count == 0] = 0
    return table.astype(np.int32)


def hinges(
    faces: Int[np.ndarray, "faces 3"],
) -> Int[np.ndarray, "hinges 4"]:
    """Interior edges with the two vertices opposite to them: (a, b, one, other).

    The opposite vertices follow the order of the faces, not the side they lie on.
    """
    f = np.asarray(faces)
    edges = mesh_edges(f)
    inner = np.flatnonzero(edges.count == 2)
    ends = edges.vertices[inner]
    opposite = []
    for side in range(2):
        face = f[edges.faces[inner, side]]
        other = (face != ends[:, :1]) & (face != ends[:, 1:])
        opposite.append(face[np.arange(len(face)), np.argmax(other, axis=1)])
    return np.column_stack([ends, *opposite]).astype(np.int32)


def greedy_coloring(
    elements: Int[np.ndarray, "elements n"], num_vertices: int
) -> list[Int[np.ndarray, " members"]]:
    """Groups of elements that share no vertex within a group.

    Greedy in the given order, so the result is deterministic. Solving one group
    after another is a Gauss-Seidel sweep; within a group all updates are independent.
    """
    e = np.asarray(elements)
    used = np.zeros((num_vertices, 64), dtype=bool)
    colour = np.empty(len(e), dtype=np.int64)
    for i, members in enumerate(e):
        free = int(np.argmin(np.append(used[members].any(axis=0), False)))
        if free == used.shape[1]:
            used = np.pad(used, ((0, 0), (0, 64)))
        colour[i] = free
        used[members, free] = True
    return [
        np.flatnonzero(colour == c).astype(np.int32) for c in range(int(colour.max(initial=-1)) + 1)
    ]


def manifold_report(
    faces: Int[np.ndarray, "faces 3"],
) -> dict[str, int]:
    """Counts common defects: non-manifold edges, duplicate faces, inconsistent winding."""
    f = np.asarray(faces, dtype=np.int64)
    edges = mesh_edges(f)
    rows = np.sort(f, axis=1)
    half = np.concatenate([f[:, [1, 2]], f[:, [2, 0]], f[:, [0, 1]]])
    # Of three faces at an edge, two always run in the same direction.
    half = half[edges.count[edges.of_face.T.reshape(-1)] == 2]
    repeated: Bool[np.ndarray, " n"] = np.unique(half, axis=0, return_counts=True)[1] > 1
    return {
        "boundary_edges": int((edges.count == 1).sum()),
        "non_manifold_edges": int((edges.count > 2).sum()),
        "duplicate_faces": len(rows) - len(np.unique(rows, axis=0)),
        "repeated_corner_faces": int(
            ((rows[:, 0] == rows[:, 1]) | (rows[:, 1] == rows[:, 2])).sum()
        ),
        "inconsistent_edges": int(repeated.sum()),
    }


def smoothing_matrix(faces: Int[np.ndarray, "faces 3"], num_vertices: int) -> sp.csr_matrix:
    """A matrix that averages each vertex with the mean of its neighbours, half and half."""
    e = mesh_edges(faces).vertices
    ones = np.ones(len(e))
    graph = sp.csr_matrix((ones, (e[:, 0], e[:, 1])), (num_vertices, num_vertices))
    graph = graph + graph.T
    degree = np.maximum(np.asarray(graph.sum(axis=1)).ravel(), 1)
    eye = sp.identity(num_vertices, format="csr")
    return sp.csr_matrix(0.5 * eye + 0.5 * sp.diags(1 / degree) @ graph)
