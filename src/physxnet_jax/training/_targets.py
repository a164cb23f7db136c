"""Targets at texels, and the scales that normalise maps to [-1, 1]."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..body import load_body, skin_points
from ..data import QUANTIZATION_STEP, Frames
from ..errors import FormatError
from ..garment import template
from ..geometry import mesh_edges
from ..models import (
    PAPER,
    BoundGarment,
    Family,
    ModelConfig,
    Normalisation,
    TexelPoints,
    bind_garment,
    clip_features,
    make_texel_points,
)
from ..typing import pytree
from ..uv import Atlas, Transference, bind, garment_map_rows, make_atlas


@pytree
@dataclasses.dataclass(frozen=True, kw_only=True)
class ClothTables:
    """Data that converts a template's stored offsets to texel targets.

    Attributes:
        to_cloth: The transference matrix T_BC.
        bound: The template bound to the atlas.
        edges: Vertex indices of its edges, shape [edges, 2].
    """

    to_cloth: Transference
    bound: BoundGarment
    edges: Array


def prepare_targets(model: ModelConfig) -> tuple[Atlas, TexelPoints, dict[str, ClothTables]]:
    """Atlas, texel points and target tables of a model's templates on the default body."""
    body = load_body()
    rest = body.rest_vertices(body.default_shape())
    atlas = make_atlas(model.resolution, skirt=model.skirt_chart)
    garments = {t: template(t) for t in model.templates}  # pyright: ignore[reportArgumentType]
    rows = {t: garment_map_rows(atlas, body, rest, g) for t, g in garments.items()}
    texel_points = make_texel_points(atlas, body, rest, {t: r.valid for t, r in rows.items()})
    tables = {
        t: ClothTables(
            to_cloth=rows[t],
            bound=bind_garment(
                body,
                rest,
                g,
                bind(g, atlas=atlas, body=body, rest=rest, valid=rows[t].valid),
                smooth=not model.skirt_chart,
            ),
            edges=jax.device_put(mesh_edges(np.asarray(g.mesh.faces)).vertices),
        )
        for t, g in garments.items()
    }
    return atlas, texel_points, tables


def target_offsets(
    stored: Int[Array, "batch vertices 3"],
    table: ClothTables,
    texel_points: TexelPoints,
    rotations: Float[Array, "batch joints 3 3"],
    translations: Float[Array, "batch joints 3"],
    family: Family,
) -> Float[Array, "batch texels 3"]:
    """Targets at texels [m] from stored vertex offsets.

    ``paper`` adds the skinning back and subtracts the skin at the texel (I_C of equation 9);
    ``local`` needs neither.
    """
    offset = stored.astype(jnp.float32) * QUANTIZATION_STEP
    if family == "local":
        return table.to_cloth @ offset
    garment, points = table.bound, texel_points
    anchor = points.rest_dress if garment.template == "dress" else points.rest

    def one(o: Array, r: Array, t: Array) -> Array:
        cloth = skin_points(garment.rest, garment.skin, r, t)[0] + o
        return table.to_cloth @ cloth - skin_points(anchor, points.weights, r, t)[0]

    return jax.vmap(one)(offset, rotations, translations)


def measure_normalisation(
    frames: Frames,
    texel_points: TexelPoints,
    tables: dict[str, ClothTables],
    family: Family,
    *,
    samples: int = 128,
    seed: int = 0,
) -> Normalisation:
    """Scales from a sample of the training frames: 99.9 % of values lie in [-1, 1].

    Args:
        frames: Training frames.
        texel_points: Texels.
        tables: From `prepare_targets`.
        family: Kind of the targets, see `target_offsets`.
        samples: Number of sampled frames.
        seed: Seed of the sample.

    Raises:
        FormatError: A template has no usable frame.

    Note (differs from the paper):
        A percentile instead of the largest value: one fast hand in one frame would
        otherwise squeeze all other motion into a few per cent of the range.
    """
    velocity, acceleration = motion_scales(frames, texel_points, samples=samples, seed=seed)
    # Its own generator: the samples of maps and of targets are independent.
    rng = np.random.default_rng(seed)
    return Normalisation(
        velocity,
        acceleration,
        {
            t: scale_of(np.abs(_sample_targets(frames, texel_points, t, table, family, rng)))
            for t, table in tables.items()
        },
    )


def scale_of(values: np.ndarray) -> Array:
    """What 99.9 % of values don't exceed."""
    return jnp.asarray(max(float(np.quantile(values, 0.999)), 1e-6), jnp.float32)


def motion_scales(
    frames: Frames, texel_points: TexelPoints, *, samples: int, seed: int
) -> tuple[Array, Array]:
    """Scales of velocities [m/s] and accelerations [m/s^2] in a sample of frames."""
    pick = np.random.default_rng(seed).choice(len(frames), min(samples, len(frames)), False)
    features_of = jax.jit(clip_features, static_argnames=("fps", "inputs"))
    # World axes, whatever frame the network uses: close enough for a scale.
    seen = dataclasses.replace(PAPER, frames=1)
    rows = [
        np.abs(
            features_of(
                texel_points.rest,
                texel_points.weights,
                frames.rotations[i, -seen.window :],
                frames.translations[i, -seen.window :],
                fps=frames.fps,
                inputs=seen,
            )[0]
        )
        for i in pick
    ]
    features = np.stack(rows)
    return scale_of(features[..., :3]), scale_of(features[..., 3:6])


def _sample_targets(
    frames: Frames,
    texel_points: TexelPoints,
    name: str,
    table: ClothTables,
    family: Family,
    rng: np.random.Generator,
) -> Float[np.ndarray, "samples texels 3"]:
    """Targets of a template in some of its usable frames, at the texels that it covers [m]."""
    good = np.flatnonzero(frames.usable[name])
    if len(good) == 0:
        raise FormatError(
            f"no usable sequence for '{name}': simulate it, or drop it from the templates."
        )
    pick = rng.choice(good, min(32, len(good)), replace=False)
    meters = target_offsets(
        jax.device_put(frames.targets[name][pick]),
        table,
        texel_points,
        jax.device_put(frames.rotations[pick, -1]),
        jax.device_put(frames.translations[pick, -1]),
        family,
    )
    return np.asarray(meters)[:, np.asarray(texel_points.valid[name])]
