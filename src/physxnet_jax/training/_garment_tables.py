"""What a network that sees garments learns from: many garments of each template, on many bodies."""

import dataclasses
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..body import load_body, skin_points
from ..data import QUANTIZATION_STEP, Frames, Wardrobe, person_shape
from ..errors import FormatError
from ..geometry import mesh_edges, pad_rows, patch_shares, polar_rotation
from ..models import ModelConfig, Normalisation, TexelPoints, make_texel_points
from ..simulation import ElasticTables, elastic_tables
from ..typing import pytree
from ..uv import Atlas, bind, condition_maps, make_atlas
from ._targets import motion_scales, scale_of

# Distance between the middles of patches [m].
_PATCH = 0.08
ERROR_UNIT = 0.01
"""Errors are relative to this length, elastic energies to lifting the garment by it [m]."""


@pytree
@dataclasses.dataclass(frozen=True, kw_only=True)
class GarmentTables:
    """All garments of a template; those with fewer vertices are padded.

    Attributes:
        texel: Texels that each vertex samples, shape [garments, vertices, k].
        weight: Their weights, shape [garments, vertices, k].
        present: 1 for vertices, 0 for padding, shape [garments, vertices].
        conditions: What the network sees of each garment, shape [garments, height, width,
            channels].
        patch: Patches of 8 cm that each vertex belongs to, shape [garments, vertices, m].
        share: Their shares in the vertex, shape [garments, vertices, m].
        patches: Number of patches of the garment that has most.
        edges: Vertices of each edge, shape [garments, edges, 2]; padding joins vertex 0 to itself.
        elastic: Vertices at rest [m], shape [garments, vertices, 3], their skinning weights, shape
            [garments, vertices, joints], and springs and hinges; None where their energy doesn't
            count.
    """

    texel: Int[Array, "garments vertices k"]
    weight: Float[Array, "garments vertices k"]
    present: Float[Array, "garments vertices"]
    conditions: Float[Array, "garments height width channels"]
    patch: Int[Array, "garments vertices m"]
    share: Float[Array, "garments vertices m"]
    edges: Int[Array, "garments edges 2"]
    elastic: tuple[Array, Array, ElasticTables] | None
    patches: int = dataclasses.field(metadata={"static": True})

    def differences(
        self, values: Float[Array, "batch vertices 3"], garment: Int[Array, " batch"]
    ) -> tuple[Float[Array, "batch edges 3"], Float[Array, "batch edges"]]:
        """Differences of vertex values along the edges of one garment each, and their weights."""
        a, b = jnp.unstack(self.edges[garment], axis=2)
        along = jax.vmap(lambda x, i, j: x[j] - x[i])(values, a, b)
        return along, (a != b).astype(values.dtype)

    def means(
        self, values: Float[Array, "batch vertices 3"], garment: Int[Array, " batch"]
    ) -> tuple[Float[Array, "batch patches 3"], Float[Array, "batch patches"]]:
        """Means of vertex values over the patches of one garment each, and their weights."""

        def one(x: Array, g: Array) -> tuple[Array, Array]:
            share = self.share[g] * self.present[g][:, None]
            rows = self.patch[g].ravel()
            weight = jnp.zeros(self.patches, x.dtype).at[rows].add(share.ravel())
            parts = (share[:, :, None] * x[:, None, :]).reshape(-1, 3)
            total = jnp.zeros((self.patches, 3), x.dtype).at[rows].add(parts)
            return total / jnp.maximum(weight, 1e-6)[:, None], weight

        return jax.vmap(one)(values, garment)

    def elastic_energy(
        self,
        offsets: Float[Array, "batch vertices 3"],
        garment: Int[Array, " batch"],
        rotations: Float[Array, "batch joints 3 3"],
        translations: Float[Array, "batch joints 3"],
    ) -> Float[Array, " batch"] | None:
        """Elastic energy of one garment each over that of lifting it by 1 cm; None if it's unknown.

        Args:
            offsets: Offsets in the vertices' own frames [m].
            garment: The garment of each sample.
            rotations: World rotations of joints.
            translations: World translations of joints [m].
        """
        if self.elastic is None:
            return None
        every = self.elastic

        def one(o: Array, g: Array, r: Array, t: Array) -> Array:
            rest, skin, mine = jax.tree.map(lambda x: x[g], every)
            points, blend = skin_points(rest, skin, r, t)
            turned = jnp.einsum("vab,vb->va", polar_rotation(blend), o, precision="highest")
            return mine.energy(points + turned) / mine.lift(ERROR_UNIT)

        return jax.vmap(one)(offsets, garment, rotations, translations)

    def sample(
        self, maps: Float[Array, "batch texels 3"], garment: Int[Array, " batch"]
    ) -> Float[Array, "batch vertices 3"]:
        """Values of maps at the vertices of one garment each."""

        def one(values: Array, g: Array) -> Array:
            texel, weight = self.texel[g], self.weight[g]
            out = jnp.zeros((), values.dtype)
            for k in range(texel.shape[1]):
                out = out + values[texel[:, k]] * weight[:, k, None]
            return out

        return jax.vmap(one)(maps, garment)


@pytree
@dataclasses.dataclass(frozen=True, kw_only=True)
class Persons:
    """The texels of motion on several bodies.

    Attributes:
        rest: Their points at rest [m], shape [persons, texels, 3].
    """

    rest: Float[Array, "persons texels 3"]


def prepare_garments(
    model: ModelConfig, wardrobe: Wardrobe, *, elastic: bool = False
) -> tuple[Atlas, Atlas, TexelPoints, Persons, dict[str, GarmentTables]]:
    """Atlases of offsets and of motion, texel points, and the tables of all garments.

    A texel is valid for a template if a vertex of one of its garments samples it.

    Args:
        model: The network.
        wardrobe: What is worn in the data, and on which bodies.
        elastic: Whether the elastic energy of the garments is needed.

    Raises:
        FormatError: The wardrobe lacks a template that is learned.
    """
    body = load_body()
    rest = body.rest_vertices(body.default_shape())
    atlas = make_atlas(model.resolution, skirt=True)
    motion_atlas = make_atlas(model.motion_resolution, skirt=True)
    every = jnp.ones(atlas.num_texels, bool)
    tables, valid = {}, {}
    for name, garments in wardrobe.garments.items():
        if not garments:
            raise FormatError(f"no '{name}' in the data: simulate one, or drop the template.")
        bound = [bind(g, atlas=atlas, body=body, rest=rest, valid=every) for g in garments]
        seen = np.zeros(atlas.num_texels, bool)
        for b in bound:
            seen[np.asarray(b.texel)[np.asarray(b.weight) > 0.0]] = True
        valid[name] = jax.device_put(seen)
        count = wardrobe.num_vertices(name)
        maps = [
            condition_maps(atlas, body, rest, g, b, model.fabrics)
            for g, b in zip(garments, bound, strict=True)
        ]
        shares = [
            pad_rows(patch_shares(np.asarray(g.mesh.vertices), np.asarray(g.mesh.faces), _PATCH))
            for g in garments
        ]
        edges = [mesh_edges(np.asarray(g.mesh.faces)).vertices for g in garments]
        tables[name] = GarmentTables(
            texel=jax.device_put(np.stack([_padded(b.texel, count) for b in bound])),
            weight=jax.device_put(np.stack([_padded(b.weight, count) for b in bound])),
            present=jax.device_put(
                np.stack([np.arange(count) < g.num_vertices for g in garments]).astype(np.float32)
            ),
            conditions=jnp.stack(maps),
            patch=jax.device_put(np.stack([_padded(i, count) for i, _ in shares])),
            share=jax.device_put(np.stack([_padded(w, count) for _, w in shares])),
            edges=jax.device_put(
                np.stack([_padded(e, max(map(len, edges))) for e in edges]).astype(np.int32)
            ),
            elastic=_elastic(wardrobe, name) if elastic else None,
            patches=max(int(i.max()) + 1 for i, _ in shares),
        )
    points = make_texel_points(motion_atlas, body, rest, valid)
    rests = jnp.stack([motion_atlas.at_texels(r) for r in wardrobe.rests()])
    return atlas, motion_atlas, points, Persons(rest=rests), tables


def _elastic(wardrobe: Wardrobe, name: str) -> tuple[Array, Array, ElasticTables]:
    """Each garment of a template on the person who wears it, with its springs and hinges."""
    garments, body = wardrobe.garments[name], load_body()
    worn = {number: o for (t, o), number in wardrobe.numbers.items() if t == name}
    outfits = (worn[k] for k in range(len(garments)))
    shapes = [person_shape(() if o is None else o.shape) for o in outfits]
    count = wardrobe.num_vertices(name)
    rests = [g.rest_vertices(body.rest_vertices(s)) for g, s in zip(garments, shapes, strict=True)]
    rest, skin = (
        jax.device_put(np.stack([_padded(x, count) for x in rows]))
        for rows in (rests, [g.skin for g in garments])
    )
    return rest, skin, elastic_tables(garments, shapes)


def _padded(values: Array | np.ndarray, count: int) -> np.ndarray:
    v = np.asarray(values)
    return np.concatenate([v, np.zeros((count - len(v), v.shape[1]), v.dtype)])


def measure_garment_normalisation(
    frames: Mapping[str, Frames],
    points: TexelPoints,
    tables: dict[str, GarmentTables],
    *,
    samples: int = 128,
    seed: int = 0,
) -> Normalisation:
    """`measure_normalisation` for offsets at vertices: 99.9 % of values lie in [-1, 1].

    Args:
        frames: Training frames of each template.
        points: Texels on the body.
        tables: All garments.
        samples: Frames from which velocities and accelerations are measured.
        seed: Seed of their choice.

    Raises:
        FormatError: A template has no usable frame.
    """
    moving = next(iter(frames.values()))
    velocity, acceleration = motion_scales(moving, points, samples=samples, seed=seed)
    offsets = {}
    for name, table in tables.items():
        own = frames[name]
        good = np.flatnonzero(own.usable[name])
        if len(good) == 0:
            raise FormatError(
                f"no usable sequence for '{name}': simulate it, or drop it from the templates."
            )
        rng = np.random.default_rng(seed)
        chosen = rng.choice(good, min(64, len(good)), replace=False)
        there = np.asarray(table.present)[own.garment[name][chosen]] > 0.0
        offsets[name] = scale_of(np.abs(own.targets[name][chosen][there] * QUANTIZATION_STEP))
    return Normalisation(velocity, acceleration, offsets)
