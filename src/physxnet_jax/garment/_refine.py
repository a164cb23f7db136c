"""Finer versions of garments, for simulation."""

import dataclasses

import jax
import numpy as np
from jaxtyping import Float

from ._garment import Garment
from ._repair import subdivide

# Smaller weights are rounding: true ones are multiples of a power of a half [1].
_ROUNDING = 1e-4


def refine_garment(garment: Garment, longest: float) -> Garment:
    """A garment with shorter edges, whose first vertices are the garment's own.

    New vertices lie on its triangles, are attached to the body as their corners are, and held
    where all corners that they lie between are held.

    Args:
        garment: The garment.
        longest: Largest length of an edge [m].

    Raises:
        MeshError: The result would have more than 400,000 vertices.
    """
    mesh, part_of = subdivide(garment.mesh, longest)
    x, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces)
    owner = np.zeros(len(x), np.int64)
    owner[faces] = part_of[:, None]
    corners = np.asarray(garment.mesh.faces)[owner]
    n = garment.num_vertices
    corners[:n] = np.arange(n)[:, None]
    weights = _barycentric(x, x[corners])
    weights[:n] = [1.0, 0.0, 0.0]
    share = weights.astype(np.float32)[:, :, None]
    skin = np.sum(share * np.asarray(garment.skin)[corners], axis=1)
    ref_weights = (share * np.asarray(garment.ref_weights)[corners]).reshape(len(x), -1)
    offset = np.sum(share * np.asarray(garment.offset)[corners], axis=1)
    held = np.asarray(garment.pinned)[corners] | (weights < _ROUNDING)
    own = garment.coarse_faces
    return dataclasses.replace(
        garment,
        mesh=mesh,
        pinned=jax.device_put(held.all(axis=1)),
        refs=jax.device_put(np.asarray(garment.refs)[corners].reshape(len(x), -1)),
        ref_weights=jax.device_put(ref_weights),
        offset=jax.device_put(offset),
        skin=jax.device_put(skin / skin.sum(axis=1, keepdims=True)),
        polygons=None,
        coarse_faces=garment.mesh.faces if own is None else own,
    )


def _barycentric(
    x: Float[np.ndarray, "points 3"], corners: Float[np.ndarray, "points 3 3"]
) -> Float[np.ndarray, "points 3"]:
    """Weights of points on triangles, the smallest ones where a triangle has no area."""
    edges = corners[:, 1:] - corners[:, :1]
    solved = np.einsum("pij,pj->pi", np.linalg.pinv(edges.transpose(0, 2, 1)), x - corners[:, 0])
    out = np.column_stack([1.0 - solved.sum(axis=1), solved])
    out = np.clip(out, 0.0, 1.0)
    return out / out.sum(axis=1, keepdims=True)
