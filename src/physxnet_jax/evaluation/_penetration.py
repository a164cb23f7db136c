"""Cloth inside the body, and body outside the cloth, measured on meshes alone."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.spatial import KDTree

from ..body import NUM_BODY_VERTICES, triangulate
from ..geometry import (
    closest_barycentric,
    connected_components,
    mesh_edges,
    vertex_faces,
    vertex_normals,
)
from ..motion import Motion, animate
from ..simulation import Assembly

# Skin that wears cloth has it within this distance at rest [m].
_UNDER = 0.08


@dataclasses.dataclass(frozen=True)
class Penetration:
    """What is on the wrong side, frame by frame.

    Attributes:
        cloth_inside: Cloth vertices inside the skin nearest to them, shape
            [frames, vertices].
        depth: How deep [m], 0 outside, likewise.
        elsewhere: Of those inside, cloth that is outside the skin it is worn on: the
            body passes through itself there and no place is outside of both.
        skin_outside: Share of the skin's vertices that wear cloth which stick out of
            its triangles by more than 0.1 mm, shape [frames].
    """

    cloth_inside: Bool[np.ndarray, "frames vertices"]
    depth: Float[np.ndarray, "frames vertices"]
    elsewhere: Bool[np.ndarray, "frames vertices"]
    skin_outside: Float[np.ndarray, " frames"]


def penetration(
    assembly: Assembly,
    motion: Motion,
    positions: Float[np.ndarray, "frames vertices 3"],
    *,
    frames: Int[np.ndarray, " looked"] | None = None,
) -> Penetration:
    """Measures penetration without asking the simulator that made the cloth.

    The nearest skin vertex is found among all, the closest point among the triangles
    around it and its neighbours, the sign by the interpolated normal there.

    Args:
        assembly: The scene's garments and body.
        motion: The body's motion.
        positions: Of all garments' vertices [m].
        frames: Which frames to look at; all by default.
    """
    looked = np.arange(len(positions)) if frames is None else np.asarray(frames)
    body = assembly.body
    faces = np.asarray(triangulate(body.quads))
    rest = jnp.asarray(assembly.rest_body, jnp.float32)
    part = Motion(
        jnp.asarray(motion.rotations)[looked], jnp.asarray(motion.root)[looked], motion.fps
    )
    skin = np.asarray(
        animate(
            body,
            rest,
            rest[:NUM_BODY_VERTICES],
            jnp.asarray(body.weights[:NUM_BODY_VERTICES]),
            part,
        )
    )
    around = vertex_faces(faces, NUM_BODY_VERTICES)
    cloth_around = vertex_faces(assembly.faces, len(assembly.rest))
    home = assembly.rest_body[:NUM_BODY_VERTICES]
    own = _nearest(home, assembly.rest)
    rim = np.zeros(len(assembly.rest), bool)
    edges = mesh_edges(assembly.faces)
    rim[edges.vertices[edges.count == 1]] = True
    outwards = _outwards(assembly, home)
    clothed = _clothed(assembly, home, rim, outwards, cloth_around)
    inside, depth, elsewhere, outside = [], [], [], []
    for k, x in zip(range(len(looked)), positions[looked]):
        s = skin[k]
        normal = np.asarray(vertex_normals(jnp.asarray(s), jnp.asarray(faces)))
        near = _nearest(s, x)
        height, _, _ = _height(x, s, normal, faces, around, near)
        wrong = height < 0
        inside.append(wrong)
        depth.append(np.where(wrong, -height, 0.0))
        # On its own limb: from the nearest skin vertex at rest.
        mine, _, _ = _height(x, s, normal, faces, around, _walk(x, s, around, faces, own))
        elsewhere.append(wrong & (mine >= 0))
        under = _nearest(x, s)
        # Only cloth that is worn on that skin: a hand beside the hip is no hole in it.
        worn = np.linalg.norm(assembly.rest[under] - home, axis=1) < _UNDER
        covered = np.flatnonzero(worn & clothed)
        cloth_normal = np.asarray(
            vertex_normals(jnp.asarray(x, jnp.float32), jnp.asarray(assembly.faces))
        )
        cloth_normal = cloth_normal * outwards[:, None]
        up, weights, face = _height(
            s[covered], x, cloth_normal, assembly.faces, cloth_around, under[covered]
        )
        # A foot on the hem is beside the cloth, not beneath it.
        beside = ((weights * rim[assembly.faces[face]]).sum(axis=1)) > 0.999
        sticks = (up > 1e-4) & ~beside
        outside.append(sticks.sum() / max(len(covered), 1))
    return Penetration(np.stack(inside), np.stack(depth), np.stack(elsewhere), np.asarray(outside))


def _outwards(assembly: Assembly, skin: Float[np.ndarray, "body 3"]) -> Float[np.ndarray, " v"]:
    """1 where a piece's triangles face away from the body, else -1."""
    x, f = assembly.rest, assembly.faces
    n = np.cross(x[f[:, 1]] - x[f[:, 0]], x[f[:, 2]] - x[f[:, 0]])
    middle = x[f].mean(axis=1)
    away = np.einsum("ij,ij->i", n, middle - skin[_nearest(skin, middle)])
    piece = connected_components(f, len(x))
    total = np.bincount(piece[f[:, 0]], away, minlength=piece.max() + 1)
    return np.where(total >= 0, 1.0, -1.0)[piece].astype(np.float32)


def _clothed(
    assembly: Assembly,
    skin: Float[np.ndarray, "body 3"],
    rim: Bool[np.ndarray, " vertices"],
    outwards: Float[np.ndarray, " vertices"],
    around: Int[np.ndarray, "vertices k"],
) -> Bool[np.ndarray, " body"]:
    """Skin that lies beneath cloth at rest, not beside its hem."""
    x = assembly.rest.astype(np.float32)
    normal = np.asarray(vertex_normals(jnp.asarray(x), jnp.asarray(assembly.faces)))
    over = _nearest(x, skin)
    up, weights, face = _height(skin, x, normal * outwards[:, None], assembly.faces, around, over)
    beneath = (up < 0) & (up > -_UNDER)
    return beneath & ((weights * ~rim[assembly.faces[face]]).sum(axis=1) > 0.05)


def _nearest(
    of: Float[np.ndarray, "many 3"], to: Float[np.ndarray, "points 3"]
) -> Int[np.ndarray, " points"]:
    return np.reshape(KDTree(of).query(to)[1], len(to))


def _walk(
    x: Float[np.ndarray, "points 3"],
    s: Float[np.ndarray, "body 3"],
    around: Int[np.ndarray, "body k"],
    faces: Int[np.ndarray, "faces 3"],
    at: Int[np.ndarray, " points"],
) -> Int[np.ndarray, " points"]:
    """Along the surface to the skin vertex that has no nearer neighbour."""
    for _ in range(60):
        ring = faces[around[at]].reshape(len(at), -1)
        gap = s[ring] - x[:, None]
        best = ring[np.arange(len(at)), np.einsum("vki,vki->vk", gap, gap).argmin(axis=1)]
        if (best == at).all():
            break
        at = best
    return at


def _height(
    points: Float[np.ndarray, "points 3"],
    mesh: Float[np.ndarray, "vertices 3"],
    normals: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    around: Int[np.ndarray, "vertices k"],
    near: Int[np.ndarray, " points"],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Signed distance to the triangles around a vertex, weights and face of the foot."""
    patch = around[near]
    # Rows of one length for many calls: each new shape would be compiled.
    rows = 1 << int(np.ceil(np.log2(max(len(points), 1))))
    index = np.pad(faces[patch], ((0, rows - len(points)), (0, 0), (0, 0)))
    p = np.pad(np.asarray(points, np.float32), ((0, rows - len(points)), (0, 0)))
    height, weights, best = _signed(
        jnp.asarray(p),
        jnp.asarray(np.asarray(mesh, np.float32)),
        jnp.asarray(np.asarray(normals, np.float32)),
        jnp.asarray(index),
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
    foot = jnp.einsum("pk,pki->pi", w, mesh[corner])
    normal = jnp.einsum("pk,pki->pi", w, normals[corner])
    gap = p - foot
    side = jnp.sign(jnp.sum(gap * normal, axis=1))
    return side * jnp.sqrt(jnp.sum(gap * gap, axis=1)), w, best
