"""What one sees at a glance: skin through cloth, and cloth through itself."""

import dataclasses
import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from ..body import NUM_BODY_VERTICES, triangulate
from ..geometry import (
    cast_rays,
    make_mesh,
    self_intersections,
    vertex_normals,
    visible_skin,
)
from ..motion import Motion
from ..simulation import Assembly
from ._skin import animated_skin

# Skin below cloth at rest, as far away as this along its normal, is covered [m].
_COVER = 0.3
# Rays start below the skin, and again past a shell that they hit [m].
_BELOW, _PAST = 0.01, 1e-4
# Shells that a ray looks through.
_SHELLS = 3


@dataclasses.dataclass(frozen=True)
class SurfaceFaults:
    """Faults of the surface of a dressed person.

    Attributes:
        visible_skin: Share of pixels that show skin which came through the cloth over it, see
            `physxnet_jax.geometry.visible_skin`.
        self_crossing: Share of faces that cross other faces of the same garment.
        visible_inner: Share of pixels that show an inner garment which came through one worn
            over it; 0 for one garment.
    """

    visible_skin: float
    self_crossing: float
    visible_inner: float = 0.0


def surface_faults(
    assembly: Assembly,
    motion: Motion,
    positions: Float[np.ndarray, "frames vertices 3"],
    *,
    frames: Int[np.ndarray, " looked"] | None = None,
) -> SurfaceFaults:
    """Measures visible skin and self-crossing, on meshes alone.

    Args:
        assembly: The scene's garments and body.
        motion: The body's motion.
        positions: Vertices of all garments [m].
        frames: Frames to look at; all by default.

    Returns:
        Shares over these frames.
    """
    looked = np.arange(len(positions)) if frames is None else np.asarray(frames)
    faces = np.asarray(triangulate(assembly.body.quads))
    skin = animated_skin(assembly, motion, looked)
    counted = _covered_faces(
        assembly.rest_body[:NUM_BODY_VERTICES], faces, assembly.rest, assembly.faces
    )
    bounds = list(zip(assembly.parts, assembly.parts[1:]))
    owner = np.searchsorted(assembly.parts, assembly.faces[:, 0], side="right") - 1
    garments = [assembly.faces[owner == k] - i for k, (i, _) in enumerate(bounds)]
    rest_of = [assembly.rest[i:j] for i, j in bounds]
    layers = [
        (k, above, _covered_faces(rest_of[k], garments[k], rest_of[above], garments[above]))
        for k, above in itertools.combinations(range(len(garments)), 2)
    ]
    through = covered = crossing = inner = outer = 0
    for s, x in zip(skin, positions[looked], strict=True):
        cloth = [(x[i:j], f) for (i, j), f in zip(bounds, garments, strict=True)]
        seen = visible_skin(s, faces, cloth, counted=counted)
        through, covered = through + seen.through, covered + seen.covered
        crossing += sum(len(np.unique(self_intersections(*mesh)[:, 1])) for mesh in cloth)
        for k, above, under in layers:
            seen = visible_skin(*cloth[k], [cloth[above]], counted=under)
            inner, outer = inner + seen.through, outer + seen.covered
    return SurfaceFaults(
        through / max(through + covered, 1),
        crossing / max(len(looked) * len(owner), 1),
        inner / max(inner + outer, 1),
    )


def _covered_faces(
    inner: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    outer: Float[np.ndarray, "cloth 3"],
    outer_faces: Int[np.ndarray, "triangles 3"],
) -> Bool[np.ndarray, " faces"]:
    """Triangles of skin, or of a garment, with cloth over them at rest."""
    floats = (np.asarray(a, np.float32).tobytes() for a in (inner, outer))
    integers = (np.asarray(a, np.int32).tobytes() for a in (faces, outer_faces))
    return _found_cover(*floats, *integers)


# Every motion of a scene has the same.
@functools.lru_cache(maxsize=8)
def _found_cover(
    inner_bytes: bytes, outer_bytes: bytes, faces_bytes: bytes, outer_faces_bytes: bytes
) -> Bool[np.ndarray, " faces"]:
    inner, outer = (np.frombuffer(b, np.float32).reshape(-1, 3) for b in (inner_bytes, outer_bytes))
    faces, outer_faces = (
        np.frombuffer(b, np.int32).reshape(-1, 3) for b in (faces_bytes, outer_faces_bytes)
    )
    x = jax.device_put(inner)
    normals = vertex_normals(x, jax.device_put(faces))
    mesh = make_mesh(outer, outer_faces)
    over, open_ = np.zeros(len(x), bool), np.ones(len(x), bool)
    # From a little below: cloth may rest on the skin or in it.
    gone = np.full(len(x), -_BELOW)
    for _ in range(_SHELLS):
        start = x + jnp.asarray(gone, jnp.float32)[:, None] * normals
        hits = cast_rays(mesh, start, normals, max_distance=_COVER)
        # Through its inner side: a bare arm faces the outer side of cloth on the trunk, and
        # the lining of a coat faces the skin with its own.
        a, b, c = (outer[corner] for corner in outer_faces[np.asarray(hits.face)].T)
        leaves = np.einsum("ij,ij->i", np.cross(b - a, c - a), np.asarray(normals)) > 0
        open_ &= np.asarray(hits.valid)
        over |= open_ & leaves
        gone = np.where(open_, gone + np.asarray(hits.distance) + _PAST, gone)
        open_ &= gone < _COVER
    covered = np.asarray(over[faces].any(axis=1))
    covered.flags.writeable = False
    return covered
