"""Maps that describe a garment to a network: how loose it is, where it ends, what it is made of."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Float, Int
from scipy.sparse.csgraph import dijkstra

from ..body import NUM_BODY_VERTICES, Body
from ..garment import FABRICS, Fabric, Garment, refine_garment
from ..geometry import boundary_loops, mesh_edges
from ._atlas import Atlas
from ._bind import Binding, bind
from ._skirt import skirt_hull

CONDITIONS = (
    "covered",
    "distance to the skin",
    "cloth over skin",
    "distance to the border",
    "bending",
    "stretch",
    "density",
    "friction",
)
"""Channels of `condition_maps`."""

# Units of the channels: about 1 for the loosest and widest clothes.
_DISTANCE, _BORDER = 0.1, 0.2
_WIDEST = 2.0
# Networks learn from meshes of edges up to the first [m]. Coarser ones leave most texels without a
# vertex; they are described by a mesh with edges up to the second.
_COARSE, _FINE = 0.03, 0.02
# The fabric of a garment that nothing is known about.
_COTTON = Fabric()


def condition_maps(
    atlas: Atlas,
    body: Body,
    rest: Float[Array, "all 3"],
    garment: Garment,
    binding: Binding,
    fabrics: Sequence[str] | None = None,
) -> Float[Array, "height width channels"]:
    """What a network sees of a garment, at the texels that it samples; zero elsewhere.

    A coarse mesh is refined first, so that a garment looks the same however it is triangulated.

    Args:
        atlas: The atlas.
        body: The body.
        rest: Its rest vertices [m].
        garment: The garment on it.
        binding: Of its vertices to the atlas.
        fabrics: Names of the fabrics that the network learned from: properties beyond theirs are
            seen as the nearest of theirs. None sees all as they are.

    Returns:
        The channels of `CONDITIONS`: 1 where there is cloth; its distance to the skin in
        decimetres; the logarithm of the cloth's area over the skin's beneath it; the distance to
        the nearest border in units of 20 cm, at most 1; and the decimal logarithms of bending,
        stretch, density and friction over those of cotton.
    """
    if _longest_edge(garment) > _COARSE:
        garment = refine_garment(garment, _FINE)
        binding = bind(
            garment, atlas=atlas, body=body, rest=rest, valid=jnp.ones(atlas.num_texels, bool)
        )
    vertices, faces = np.asarray(garment.mesh.vertices, np.float64), np.asarray(garment.mesh.faces)
    # A triangle that names a vertex twice has an edge that would pass for a border.
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    beneath = _points_beneath(atlas, body, rest, garment, binding)
    fabric = _fabric(garment.fabric)
    if fabrics:
        known = np.stack([_fabric(FABRICS[name]) for name in fabrics])
        fabric = np.clip(fabric, known.min(axis=0), known.max(axis=0))
    values = np.column_stack(
        [
            np.ones(len(vertices)),
            np.linalg.norm(vertices - beneath, axis=1) / _DISTANCE,
            _area_ratio(vertices, beneath, faces),
            np.minimum(_to_border(vertices, faces) / _BORDER, 1.0),
            np.broadcast_to(fabric, (len(vertices), len(fabric))),
        ]
    )
    texel, weight = np.asarray(binding.texel), np.asarray(binding.weight, np.float64)
    rows = np.repeat(np.arange(len(texel)), texel.shape[1])
    sampling = sp.csr_matrix(
        (weight.ravel(), (texel.ravel(), rows)), (atlas.num_texels, len(texel))
    )
    total = np.asarray(sampling.sum(axis=1)).ravel()
    seen = total > 1e-6
    means = np.where(seen[:, None], (sampling @ values) / np.maximum(total, 1e-6)[:, None], 0.0)
    return _closed(atlas.to_map(jax.device_put(means.astype(np.float32))))


def _longest_edge(garment: Garment) -> float:
    x, edges = np.asarray(garment.mesh.vertices), mesh_edges(np.asarray(garment.mesh.faces))
    a, b = edges.vertices.T
    return float(np.linalg.norm(x[a] - x[b], axis=1).max())


def _points_beneath(
    atlas: Atlas, body: Body, rest: Float[Array, "all 3"], garment: Garment, binding: Binding
) -> Float[np.ndarray, "vertices 3"]:
    """Points of the skin, or of the hull around the legs, that vertices are bound to [m]."""
    skin = np.asarray(binding.to_body @ rest[:NUM_BODY_VERTICES], np.float64)
    if binding.texel.shape[1] == 4:
        return skin
    hull = skirt_hull(body, np.asarray(rest))
    on_hull = hull.points(*hull.angle_and_drop(np.asarray(garment.mesh.vertices)))
    share = np.asarray(binding.weight, np.float64)[:, 4:].sum(axis=1, keepdims=True)
    return skin + share * (on_hull - skin)


def _area_ratio(
    vertices: Float[np.ndarray, "vertices 3"],
    beneath: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
) -> Float[np.ndarray, " vertices"]:
    """The logarithm of the area around each vertex over that of what lies beneath."""

    def around(x: np.ndarray) -> np.ndarray:
        a, b, c = (x[faces[:, k]] for k in range(3))
        area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
        return np.bincount(faces.ravel(), np.repeat(area, 3), len(x))

    ratio = np.maximum(around(vertices), 1e-9) / np.maximum(around(beneath), 1e-9)
    return np.clip(np.log(ratio), -_WIDEST, _WIDEST)


def _to_border(
    vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> Float[np.ndarray, " vertices"]:
    """Distance along the cloth to the nearest border [m]; infinite without one."""
    loops = boundary_loops(faces)
    if not loops:
        return np.full(len(vertices), np.inf)
    edges = mesh_edges(faces).vertices
    length = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
    graph = sp.csr_matrix(
        (np.maximum(length, 1e-9), (edges[:, 0], edges[:, 1])), (len(vertices), len(vertices))
    )
    return dijkstra(graph, directed=False, indices=np.concatenate(loops), min_only=True)


def _fabric(fabric: Fabric) -> Float[np.ndarray, " channels"]:
    def stretch(f: Fabric) -> float:
        return f.stretch if f.warp is None else f.warp

    pairs = (
        (fabric.bend, _COTTON.bend),
        (stretch(fabric), stretch(_COTTON)),
        (fabric.density, _COTTON.density),
        (fabric.friction, _COTTON.friction),
    )
    return np.log10([max(mine, 1e-9) / usual for mine, usual in pairs])


def _closed(maps: Float[Array, "height width channels"]) -> Float[Array, "height width channels"]:
    """Fills single texels that no vertex samples with the mean of their neighbours."""
    m = np.asarray(maps)
    padded = np.pad(m, ((1, 1), (1, 1), (0, 0)))
    height, width, _ = m.shape
    places = [(dy, dx) for dy in range(3) for dx in range(3) if (dy, dx) != (1, 1)]
    around = np.sum([padded[dy : dy + height, dx : dx + width] for dy, dx in places], axis=0)
    count = around[..., :1]
    hole = (m[..., :1] == 0.0) & (count >= 4.0)
    return jax.device_put(np.where(hole, around / np.maximum(count, 1.0), m))
