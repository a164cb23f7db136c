"""Fine meshes: cloth is computed at a few of their vertices, which the others follow."""

import dataclasses

import jax
import numpy as np
from jaxtyping import Array, Float, Int

from ...garment import Garment, SkinnedGarment, make_skinned, skin_garment
from ...geometry import FINE_MESH, NUM_SITES, TriMesh, coarse_mesh, linear_weights
from ...typing import pytree


@pytree
@dataclasses.dataclass(frozen=True, kw_only=True)
class Sites:
    """Some vertices of a fine mesh, and how the others follow them.

    Attributes:
        rows: The vertices, shape [sites].
        faces: Triangles between them, shape [coarse, 3].
        near: Sites that each vertex follows, shape [k, vertices].
        weight: Their weights, shape [k, vertices].
        whole: The garment with all its vertices.
    """

    rows: Int[Array, " sites"]
    faces: Int[Array, "coarse 3"]
    near: Int[Array, "k vertices"]
    weight: Float[Array, "k vertices"]
    whole: SkinnedGarment

    def expand(
        self,
        worn: SkinnedGarment,
        cloth: Float[Array, "sites 3"],
        rotations: Float[Array, "joints 3 3"],
        translations: Float[Array, "joints 3"],
    ) -> Float[Array, "vertices 3"]:
        """All vertices [m]: skinned, and displaced as the sites are from their skinning.

        Args:
            worn: The garment at its sites.
            cloth: Positions of the sites [m].
            rotations: World rotations of joints.
            translations: World translations of joints [m].
        """
        at = rotations, translations
        return self.carry(skin_garment(self.whole, *at), cloth - skin_garment(worn, *at))

    def carry(
        self, cloth: Float[Array, "vertices 3"], change: Float[Array, "sites 3"]
    ) -> Float[Array, "vertices 3"]:
        """All vertices, displaced by what is interpolated from displacements of the sites [m]."""
        for near, weight in zip(self.near, self.weight, strict=True):
            cloth = cloth + change[near] * weight[:, None]
        return cloth

    def at_rest(self, rest: Float[Array, "vertices 3"]) -> "Sites":
        """The same with other rest vertices [m]."""
        return dataclasses.replace(self, whole=dataclasses.replace(self.whole, rest=rest))


def make_sites(garment: Garment, rest: Float[Array, "all 3"]) -> Sites | None:
    """Sites of a garment with a fine mesh; None for others.

    Pinned vertices and those at borders are preferred. Garments of the tailor have none.

    Args:
        garment: The garment.
        rest: Rest vertices of the body [m].
    """
    if garment.num_vertices <= FINE_MESH or garment.elastic or garment.coarse_faces is not None:
        return None
    vertices, faces = (np.asarray(x) for x in (garment.mesh.vertices, garment.mesh.faces))
    used = np.zeros(len(vertices), bool)
    used[faces] = True
    first = np.flatnonzero(np.asarray(garment.pinned) & used)
    rows, coarse, label = coarse_mesh(vertices, faces, NUM_SITES, first)
    if not len(coarse):
        return None
    near, weight = linear_weights(vertices, faces, rows, label)
    return Sites(
        rows=jax.device_put(rows.astype(np.int32)),
        faces=jax.device_put(coarse.astype(np.int32)),
        near=jax.device_put(np.ascontiguousarray(near.T).astype(np.int32)),
        weight=jax.device_put(np.ascontiguousarray(weight.T).astype(np.float32)),
        whole=make_skinned(garment, rest),
    )


def garment_at_sites(sites: Sites | None, garment: Garment) -> Garment:
    """The garment with the coarse mesh; unchanged without sites."""
    if sites is None:
        return garment
    at = sites.rows
    return dataclasses.replace(
        garment,
        mesh=TriMesh(garment.mesh.vertices[at], sites.faces),
        pinned=garment.pinned[at],
        refs=garment.refs[at],
        ref_weights=garment.ref_weights[at],
        offset=garment.offset[at],
        skin=garment.skin[at],
        polygons=None,
        loops={},
    )


def clip_at_sites(
    sites: Sites | None, positions: Float[np.ndarray, "frames vertices 3"]
) -> Float[np.ndarray, "frames sites 3"]:
    """A clip of a garment at its sites [m]; unchanged without."""
    return positions if sites is None else positions[:, np.asarray(sites.rows)]


def carry_clip(
    sites: Sites | None,
    positions: Float[np.ndarray, "frames vertices 3"],
    moved: Float[np.ndarray, "frames sites 3"],
) -> Float[np.ndarray, "frames vertices 3"]:
    """The clip of a garment [m] where its sites have moved."""
    if sites is None:
        return moved
    change = moved - clip_at_sites(sites, positions)
    every = zip(positions, change, strict=True)
    return np.stack([np.asarray(_carried(sites, x, m)) for x, m in every])


@jax.jit
def _carried(sites: Sites, cloth: Array, change: Array) -> Array:
    return sites.carry(cloth, change)
