"""The network's maps as pictures."""

import functools
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float, Int, UInt8

from ..dressing import Dresser
from ..models import BoundGarment, Modulation, Predictor, clip_features


def texel_picture(
    values: Float[np.ndarray, "texels 3"],
    texels: Int[np.ndarray, " texels"],
    height: int,
    width: int,
) -> UInt8[np.ndarray, "height width 3"]:
    """A map of three channels as a picture: zero is grey, empty texels are white.

    Args:
        values: Its covered texels.
        texels: Their indices, row by row.
        height: Rows of the map.
        width: Columns of the map.
    """
    scale = max(float(np.quantile(np.abs(values), 0.98)), 1e-9)
    flat = np.full((height * width, 3), 255, np.uint8)
    flat[texels] = (127 + 120 * np.clip(values / scale, -1, 1)).astype(np.uint8)
    return flat.reshape(height, width, 3)


def frame_maps(
    dresser: Dresser,
    world: Float[Array, "window joints 3 3"],
    shift: Float[Array, "window joints 3"],
    fps: float,
) -> dict[str, UInt8[np.ndarray, "height width 3"]]:
    """The network's inputs and outputs for a frame, as pictures.

    Args:
        dresser: The network and what it dresses.
        world: World rotations of joints, the window's last frame being the one shown.
        shift: World translations of joints [m].
        fps: Frames per second.

    Returns:
        Pictures by name: velocity, acceleration, then an offset map for each template; of several
        garments of one template that of the first.
    """
    predictor = dresser.predictor
    assert predictor is not None, "skinning has no maps"
    worn: dict[str, Modulation | None] = {}
    for garment in dresser.worn:
        assert isinstance(garment, BoundGarment)
        worn.setdefault(garment.template, garment.modulation)
    known = {t: m for t, m in worn.items() if m is not None}
    inputs = predictor.config.inputs
    features, offset_maps = _maps(predictor, world, shift, known or None, fps, tuple(worn))
    atlas, motion_atlas = predictor.atlas, predictor.motion_atlas
    out, start = {}, 0
    for kind in inputs.kinds:
        width = inputs.width(kind)
        if kind in ("velocity", "acceleration"):
            # The last of the window's frames is the one shown.
            last = np.asarray(features)[:, start + width - 3 : start + width]
            texels = np.asarray(motion_atlas.texels)
            out[kind] = texel_picture(last, texels, motion_atlas.height, motion_atlas.width)
        start += width
    for name, offsets in offset_maps.items():
        texels = np.asarray(atlas.texels)
        out[name] = texel_picture(np.asarray(offsets), texels, atlas.height, atlas.width)
    return out


@functools.partial(jax.jit, static_argnames=("fps", "templates"))
def _maps(
    predictor: Predictor,
    world: Array,
    shift: Array,
    modulation: Mapping[str, Modulation] | None,
    fps: float,
    templates: tuple[str, ...],
) -> Any:
    texel_points = predictor.texel_points
    features = clip_features(
        texel_points.rest, texel_points.weights, world, shift, fps, predictor.config.inputs
    )[0]
    found = predictor(world, shift, fps, templates, modulation)
    return features, jax.tree.map(lambda x: x[0], found)


def magnified(
    picture: UInt8[np.ndarray, "height width 3"], size: int
) -> UInt8[np.ndarray, "rows size 3"]:
    """Resizes a picture to a width with nearest-neighbour sampling, so that texels stay squares."""
    height, width, _ = picture.shape
    rows = np.arange(size * height // width) * width // size
    return picture[rows][:, np.arange(size) * width // size]
