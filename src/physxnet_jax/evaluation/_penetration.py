"""Cloth inside the body, and body outside the cloth, measured on meshes alone."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.spatial import KDTree

from ..body import NUM_BODY_VERTICES, body_segments, triangulate
from ..geometry import (
    cast_rays,
    closest_barycentric,
    connected_components,
    make_mesh,
    mesh_edges,
    vertex_faces,
    vertex_normals,
)
from ..motion import Motion
from ..simulation import Assembly
from ._skin import animated_skin

# Largest distance at rest between skin and the cloth that covers it [m].
_MAX_CLOTH_DISTANCE = 0.08
# Clearance above skin that isn't in a fold [m].
_OPEN_CLEARANCE = 0.005
# Cloth covers skin that lies at most this far below it [m].
_MAX_COVER_HEIGHT = 0.03
# Cloth has clearance where other skin is no nearer than this share of its thickness.
_CLEARANCE_SHARE = 0.7
# Bound on how far skin rises above the tangent plane of a neighbouring vertex [m].
_MAX_CURVATURE_RISE = 0.01


@dataclasses.dataclass(frozen=True)
class Penetration:
    """Penetrations of every frame: cloth inside the body, and skin outside the cloth.

    Attributes:
        cloth_inside: Cloth vertices inside the nearest skin or inside any limb, shape
            [frames, vertices].
        depth: Depth below the nearest skin or below the limb's skin [m], 0 outside, shape
            [frames, vertices].
        pinched: Those inside that have no clearance above the skin they are worn on. The
            point one thickness above that skin lies within another limb, or other skin is
            nearer to it than that. The body folds or passes through itself there.
        skin_outside: Share of the covered skin's vertices that stick out of the nearest
            cloth triangle by more than 0.1 mm and have no cloth within 3 cm above them,
            shape [frames]. Skin without clearance for cloth above it, in a fold or within
            another limb, isn't counted.
    """

    cloth_inside: Bool[np.ndarray, "frames vertices"]
    depth: Float[np.ndarray, "frames vertices"]
    pinched: Bool[np.ndarray, "frames vertices"]
    skin_outside: Float[np.ndarray, " frames"]


def penetration(
    assembly: Assembly,
    motion: Motion,
    positions: Float[np.ndarray, "frames vertices 3"],
    *,
    frames: Int[np.ndarray, " looked"] | None = None,
    bare_skin: bool = True,
) -> Penetration:
    """Measures penetration on meshes alone, independently of the cloth's simulator.

    The nearest skin vertex is searched among all vertices, and among those of each body
    segment. The closest point lies on the triangles around that vertex; the interpolated
    normal there determines the sign. Points closest to a segment's open end count as outside
    that segment.

    Args:
        assembly: The scene's garments and body.
        motion: The body's motion.
        positions: Vertices of all garments [m].
        frames: Frames to measure; all by default.
        bare_skin: Measure skin outside the cloth as well, which takes a third of the time;
            ``skin_outside`` is NaN otherwise.
    """
    looked = np.arange(len(positions)) if frames is None else np.asarray(frames)
    body = assembly.body
    faces = np.asarray(triangulate(body.quads))
    skin = animated_skin(assembly, motion, looked)
    rest_skin = assembly.rest_body[:NUM_BODY_VERTICES]
    rest_nearest = _nearest(rest_skin, assembly.rest)
    build = _SkinTopology(
        faces,
        vertex_faces(faces, NUM_BODY_VERTICES),
        body_segments(np.asarray(body.weights)[:NUM_BODY_VERTICES], body),
        _limbs(assembly, faces),
    )
    under = _CoveredSkin(assembly, rest_skin) if bare_skin else None
    inside, depth, pinched, outside = [], [], [], []
    for s, x in zip(skin, positions[looked], strict=True):
        posed = _PosedSkin(build, s)
        height = posed.height(x, posed.nearest(x))[0]
        lowest = np.minimum(height, posed.height_in_limbs(x))
        wrong = lowest < 0
        inside.append(wrong)
        depth.append(np.where(wrong, -lowest, 0.0))
        # The skin it is worn on: a walk over the surface from the nearest vertex at rest.
        rows = np.flatnonzero(wrong)
        at = _walk(x[rows], s, build.around, faces, rest_nearest[rows])
        closest, up = posed.closest(x[rows], at)
        narrow = np.zeros(len(x), bool)
        narrow[rows] = posed.lacks_clearance(closest, up, assembly.thickness[rows], at)
        pinched.append(narrow)
        outside.append(np.nan if under is None else under.bare(posed, x))
    return Penetration(np.stack(inside), np.stack(depth), np.stack(pinched), np.asarray(outside))


@dataclasses.dataclass(frozen=True)
class _SkinTopology:
    """Topology of the skin, which is the same in every frame."""

    faces: Int[np.ndarray, "faces 3"]
    around: Int[np.ndarray, "body k"]
    segment: Int[np.ndarray, " body"]
    limbs: "list[_Limb]"


class _PosedSkin:
    """The skin of one frame, with distance queries."""

    def __init__(self, build: _SkinTopology, vertices: Float[np.ndarray, "body 3"]) -> None:
        self._build, self.vertices = build, vertices
        self.normals = vertex_normals(vertices, build.faces)
        self._whole = _tree(vertices)
        self._trees = [_tree(vertices[limb.vertices]) for limb in build.limbs]

    def nearest(self, points: Float[np.ndarray, "points 3"]) -> Int[np.ndarray, " points"]:
        return _query(self._whole, points)

    def height(
        self, points: Float[np.ndarray, "points 3"], near: Int[np.ndarray, " points"]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """`_height` over the triangles around these vertices."""
        build = self._build
        return _height(points, self.vertices, self.normals, build.faces, build.around, near)

    def closest(
        self, points: Float[np.ndarray, "points 3"], near: Int[np.ndarray, " points"]
    ) -> tuple[np.ndarray, np.ndarray]:
        """The closest points on the skin around these vertices [m], and their normals."""
        _, weights, face = self.height(points, near)
        corners = self._build.faces[face]
        closest, up = (
            np.einsum("pk,pki->pi", weights, a[corners]) for a in (self.vertices, self.normals)
        )
        return closest, up

    def height_in_limbs(
        self,
        points: Float[np.ndarray, "points 3"],
        *,
        exclude: Int[np.ndarray, " points"] | None = None,
    ) -> Float[np.ndarray, " points"]:
        """Least height over any limb's skin [m], at most 0, without segment ``exclude``."""
        x, s, normal = points, self.vertices, self.normals
        out = np.zeros(len(x))
        for limb, tree in zip(self._build.limbs, self._trees, strict=True):
            rows = np.arange(len(x)) if exclude is None else np.flatnonzero(exclude != limb.segment)
            far, near = map(np.asarray, tree.query(x[rows], distance_upper_bound=limb.max_depth))
            rows, near = rows[np.isfinite(far)], limb.vertices[near[np.isfinite(far)]]
            # Only points below or just above the nearest vertex's tangent plane can be inside.
            under = np.einsum("pi,pi->p", x[rows] - s[near], normal[near]) < _MAX_CURVATURE_RISE
            rows, near = rows[under], near[under]
            if not len(rows):
                continue
            height, weights, face = _height(x[rows], s, normal, limb.faces, limb.around, near)
            at_end = (weights * limb.rim[limb.faces[face]]).sum(axis=1) > 0.999
            out[rows] = np.minimum(out[rows], np.where(at_end, 0.0, height))
        return out

    def lacks_clearance(
        self,
        closest: Float[np.ndarray, "points 3"],
        up: Float[np.ndarray, "points 3"],
        clearance: Float[np.ndarray, " points"],
        at: Int[np.ndarray, " points"],
    ) -> Bool[np.ndarray, " points"]:
        """Whether these points of the skin lack this clearance above them."""
        above = closest + clearance[:, None] * up
        clear = self.height(above, self.nearest(above))[0]
        crossed = self.height_in_limbs(above, exclude=self._build.segment[at]) < 0
        return crossed | (clear < _CLEARANCE_SHARE * clearance)


class _CoveredSkin:
    """The skin that cloth covers at rest, and how much of it sticks out."""

    def __init__(self, assembly: Assembly, rest_skin: Float[np.ndarray, "body 3"]) -> None:
        self._assembly, self._home = assembly, rest_skin
        self._around = vertex_faces(assembly.faces, len(assembly.rest))
        self._rim = np.zeros(len(assembly.rest), bool)
        edges = mesh_edges(assembly.faces)
        self._rim[edges.vertices[edges.count == 1]] = True
        self._outwards = _outwards(assembly, rest_skin)
        self._is_covered = _is_covered(assembly, rest_skin, self._rim, self._outwards, self._around)

    def bare(self, skin: _PosedSkin, x: Float[np.ndarray, "vertices 3"]) -> float:
        """Share of the covered skin that sticks out of the cloth."""
        faces, s = self._assembly.faces, skin.vertices
        under = _nearest(x, s)
        # Only cloth that is worn on that skin: a hand in front of a hip isn't uncovered.
        worn = np.linalg.norm(self._assembly.rest[under] - self._home, axis=1) < _MAX_CLOTH_DISTANCE
        covered = np.flatnonzero(worn & self._is_covered)
        normal = vertex_normals(x.astype(np.float32), faces)
        normal = normal * self._outwards[:, None]
        up, weights, face = _height(s[covered], x, normal, faces, self._around, under[covered])
        # Skin whose closest point lies on the hem is beside the cloth, not beneath it.
        beside = ((weights * self._rim[faces[face]]).sum(axis=1)) > 0.999
        bare = covered[(up > 1e-4) & ~beside]
        clearance = np.full(len(bare), _OPEN_CLEARANCE)
        seen = ~skin.lacks_clearance(s[bare], skin.normals[bare], clearance, bare)
        seen &= ~_under_cloth(s[bare], skin.normals[bare], x, faces)
        return seen.sum() / max(len(covered), 1)


@dataclasses.dataclass(frozen=True)
class _Limb:
    segment: int
    vertices: Int[np.ndarray, " mine"]
    faces: Int[np.ndarray, "faces 3"]
    around: Int[np.ndarray, "body k"]
    rim: Bool[np.ndarray, " body"]
    max_depth: float


def _limbs(assembly: Assembly, faces: Int[np.ndarray, "faces 3"]) -> list[_Limb]:
    """The skin's segments as separate meshes, open where they join each other."""
    body = assembly.body
    segment = body_segments(np.asarray(body.weights)[:NUM_BODY_VERTICES], body)
    out = []
    for k in np.unique(segment):
        mine = faces[(segment[faces] == k).all(axis=1)]
        edges = mesh_edges(mine)
        rim = np.zeros(NUM_BODY_VERTICES, bool)
        rim[edges.vertices[edges.count == 1]] = True
        around = vertex_faces(mine, NUM_BODY_VERTICES)
        vertices = np.unique(mine)
        # No point of a limb lies deeper than half its least width.
        x = assembly.rest_body[vertices]
        axes = np.linalg.svd(x - x.mean(axis=0), full_matrices=False)[2]
        width = np.ptp(x @ axes.T, axis=0)[2]
        out.append(_Limb(int(k), vertices, mine, around, rim, 0.5 * float(width)))
    return out


def _outwards(assembly: Assembly, skin: Float[np.ndarray, "body 3"]) -> Float[np.ndarray, " v"]:
    """1 where a piece's triangles face away from the body, else -1."""
    x, f = assembly.rest, assembly.faces
    n = np.cross(x[f[:, 1]] - x[f[:, 0]], x[f[:, 2]] - x[f[:, 0]])
    middle = x[f].mean(axis=1)
    away = np.einsum("ij,ij->i", n, middle - skin[_nearest(skin, middle)])
    piece = connected_components(f, len(x))
    total = np.bincount(piece[f[:, 0]], away, minlength=piece.max() + 1)
    return np.where(total >= 0, 1.0, -1.0)[piece].astype(np.float32)


def _is_covered(
    assembly: Assembly,
    skin: Float[np.ndarray, "body 3"],
    rim: Bool[np.ndarray, " vertices"],
    outwards: Float[np.ndarray, " vertices"],
    around: Int[np.ndarray, "vertices k"],
) -> Bool[np.ndarray, " body"]:
    """Skin that lies beneath cloth at rest, not beside its hem."""
    x = assembly.rest.astype(np.float32)
    normal = vertex_normals(x, assembly.faces)
    over = _nearest(x, skin)
    up, weights, face = _height(skin, x, normal * outwards[:, None], assembly.faces, around, over)
    beneath = (up < 0) & (up > -_MAX_CLOTH_DISTANCE)
    return beneath & ((weights * ~rim[assembly.faces[face]]).sum(axis=1) > 0.05)


def _tree(points: Float[np.ndarray, "points 3"]) -> KDTree:
    # Built for every frame and queried once: a balanced tree would take longer to build.
    return KDTree(points, balanced_tree=False, compact_nodes=False)


def _nearest(
    of: Float[np.ndarray, "many 3"], to: Float[np.ndarray, "points 3"]
) -> Int[np.ndarray, " points"]:
    return _query(_tree(of), to)


def _query(tree: KDTree, points: Float[np.ndarray, "points 3"]) -> Int[np.ndarray, " points"]:
    return np.reshape(tree.query(points)[1], len(points))


def _walk(
    x: Float[np.ndarray, "points 3"],
    s: Float[np.ndarray, "body 3"],
    around: Int[np.ndarray, "body k"],
    faces: Int[np.ndarray, "faces 3"],
    at: Int[np.ndarray, " points"],
) -> Int[np.ndarray, " points"]:
    """Walks along the surface to a skin vertex that has no nearer neighbour."""
    for _ in range(60):
        ring = faces[around[at]].reshape(len(at), 3 * around.shape[1])
        gap = s[ring] - x[:, None]
        best = ring[np.arange(len(at)), np.einsum("vki,vki->vk", gap, gap).argmin(axis=1)]
        if (best == at).all():
            break
        at = best
    return at


def _under_cloth(
    points: Float[np.ndarray, "points 3"],
    directions: Float[np.ndarray, "points 3"],
    cloth: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
) -> Bool[np.ndarray, " points"]:
    """Whether a ray along each skin normal hits cloth, as under an overhanging fold."""
    rows = 1 << int(np.ceil(np.log2(max(len(points), 64))))
    pad = ((0, rows - len(points)), (0, 0))
    mesh = make_mesh(np.asarray(cloth, np.float32), faces)
    hits = cast_rays(
        mesh,
        jnp.asarray(np.pad(points, pad), jnp.float32),
        jnp.asarray(np.pad(directions, pad), jnp.float32),
        max_distance=_MAX_COVER_HEIGHT,
    )
    return np.asarray(hits.valid)[: len(points)]


def _height(
    points: Float[np.ndarray, "points 3"],
    mesh: Float[np.ndarray, "vertices 3"],
    normals: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    around: Int[np.ndarray, "vertices k"],
    near: Int[np.ndarray, " points"],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Signed distance to the triangles around a vertex; the closest point's weights and face."""
    patch = around[near]
    # Padded to powers of two, because every new shape is compiled.
    rows = 1 << int(np.ceil(np.log2(max(len(points), 1))))
    index = np.pad(faces[patch], ((0, rows - len(points)), (0, 0), (0, 0)))
    p = np.pad(np.asarray(points, np.float32), ((0, rows - len(points)), (0, 0)))
    height, weights, best = _signed(
        jax.device_put(p),
        jax.device_put(np.asarray(mesh, np.float32)),
        jax.device_put(np.asarray(normals, np.float32)),
        jax.device_put(index),
    )
    n = len(points)
    best = np.asarray(best)[:n]
    return np.asarray(height)[:n], np.asarray(weights)[:n], patch[np.arange(n), best]


@jax.jit
def _signed(p: Array, mesh: Array, normals: Array, index: Array) -> tuple[Array, Array, Array]:
    tri = [jnp.moveaxis(mesh[index[..., k]], -1, 0) for k in range(3)]
    q = jnp.broadcast_to(p.T[..., None], tri[0].shape)
    weights, squared = closest_barycentric(q, *tri)
    best = jnp.argmin(squared, axis=1)
    w = jnp.take_along_axis(weights, best[None, :, None], axis=2)[..., 0].T
    corner = jnp.take_along_axis(index, best[:, None, None], axis=1)[:, 0]
    closest = jnp.einsum("pk,pki->pi", w, mesh[corner], precision=jax.lax.Precision.HIGHEST)
    normal = jnp.einsum("pk,pki->pi", w, normals[corner], precision=jax.lax.Precision.HIGHEST)
    gap = p - closest
    side = jnp.sign(jnp.sum(gap * normal, axis=1))
    return side * jnp.sqrt(jnp.sum(gap * gap, axis=1)), w, best
