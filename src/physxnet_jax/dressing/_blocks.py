"""Clips dressed block by block: by the network, by skinning, by the simulator."""

import functools
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..body import Body
from ..garment import Garment
from ..geometry import each_frame
from ..models import Predictor, Wearable, dress_frames, skin_wearable
from ..motion import BLOCK, Motion, padded_block
from ..simulation import (
    ACCURACY,
    ROLLOUT_BLOCK,
    Scene,
    prepare_scene,
    simulate_batch,
    standard_effects,
)
from ._layers import Layer, inside_out, keep_layers_apart
from ._push_out import SkinPatch, push_out, skin_height
from ._stages import Stage


def lead_frames(predictor: Predictor | None) -> int:
    """Frames before the first one that a method has to see."""
    return 0 if predictor is None else predictor.config.inputs.window - 1


@functools.partial(jax.jit, static_argnames=("fps", "pushed"))
def dress_block(
    predictor: Predictor | None,
    wearables: tuple[Wearable, ...],
    patches: tuple[SkinPatch, ...],
    layers: tuple[Layer, ...],
    rotations: Float[Array, "padded joints 3 3"],
    translations: Float[Array, "padded joints 3"],
    fps: float,
    pushed: bool,
) -> tuple[tuple[Array, Array], ...]:
    """Garments of a block of frames and the share of vertices inside before push-out."""
    last = slice(lead_frames(predictor), None)
    r, t = rotations[last], translations[last]
    if predictor is None:
        raw = tuple(jax.vmap(lambda a, b, w=w: skin_wearable(w, a, b))(r, t) for w in wearables)
    else:
        raw = dress_frames(predictor, wearables, rotations, translations, fps)
    worn, inside = [], []
    for x, patch in zip(raw, patches, strict=True):

        def one(x: Array, r: Array, t: Array, q: SkinPatch = patch) -> tuple[Array, Array]:
            return push_out(q, x, r, t) if pushed else x, skin_height(q, x, r, t)[0]

        x, height = each_frame(one, x, r, t)
        worn.append(x)
        inside.append(jnp.mean((height < 0).astype(x.dtype), axis=1))
    if pushed:
        worn = keep_layers_apart(layers, worn)
    return tuple(zip(worn, inside, strict=True))


def predict_clip(
    predictor: Predictor | None,
    wearables: Sequence[Wearable],
    patches: Sequence[SkinPatch],
    layers: Sequence[Layer],
    world: np.ndarray,
    shift: np.ndarray,
    before: tuple[np.ndarray, np.ndarray],
    fps: float,
    pushed: bool,
    stages: list[Stage],
    progress: Callable[[str, int, int], None] | None,
) -> tuple[dict[str, np.ndarray], dict[str, float]]:
    """Positions of each garment [m], and the share of its vertices inside before push-out.

    ``before`` are the joints' transforms in `lead_frames` frames before the clip.
    """
    lead = lead_frames(predictor)
    if lead:
        world, shift = (np.concatenate(pair) for pair in zip(before, (world, shift), strict=True))
    name = "network" if predictor is not None else "skinning"
    frames = len(world) - lead
    blocks, times = [], []
    for start in range(0, frames, BLOCK):
        began = time.perf_counter()
        out = dress_block(
            predictor,
            tuple(wearables),
            tuple(patches),
            tuple(layers),
            jnp.asarray(padded_block(world, start + lead, lead)),
            jnp.asarray(padded_block(shift, start + lead, lead)),
            fps,
            pushed,
        )
        blocks.append(jax.tree.map(np.asarray, out))
        times.append(1e3 * (time.perf_counter() - began))
        if progress is not None:
            progress(name, min(start + BLOCK, frames), frames)
    warm = float(np.median(times[1:])) / BLOCK if len(times) > 1 else None
    stages.append(Stage(name, times[0], warm))
    positions, inside = {}, {}
    for k, w in enumerate(wearables):
        positions[w.name] = np.concatenate([b[k][0] for b in blocks])[:frames]
        inside[w.name] = float(np.concatenate([b[k][1] for b in blocks])[:frames].mean())
    return positions, inside


def lift_clip(
    layers: Sequence[Layer], wearables: Sequence[Wearable], positions: dict[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """Garments of a clip [m], each off those beneath it once more."""
    if not layers:
        return positions
    names = [w.name for w in wearables]
    frames = len(positions[names[0]])
    blocks = []
    for at in range(0, frames, BLOCK):
        worn = tuple(jnp.asarray(padded_block(positions[n], at, 0)) for n in names)
        blocks.append([np.asarray(x) for x in _lift_block(tuple(layers), worn)])
    return {n: np.concatenate([b[k] for b in blocks])[:frames] for k, n in enumerate(names)}


@jax.jit
def _lift_block(layers: tuple[Layer, ...], worn: tuple[Array, ...]) -> tuple[Array, ...]:
    return tuple(keep_layers_apart(layers, worn))


def simulate_clip(
    garments: Sequence[Garment],
    clip: Motion,
    body: Body,
    shape: Any | None,
    accuracy: str,
    stages: list[Stage],
    progress: Callable[[str, int, int], None] | None,
) -> dict[str, np.ndarray]:
    ticks = [time.perf_counter()]

    def tick(done: int, total: int) -> None:
        ticks.append(time.perf_counter())
        if progress is not None:
            progress("simulation", done, total)

    order = inside_out(garments)
    scene = Scene(tuple(order), standard_effects(len(order)), body, shape)
    solver = ACCURACY[accuracy].at_rate(clip.fps)
    rollout = simulate_batch(prepare_scene(scene), [clip], solver=solver, progress=tick)[0]
    rollout.check()
    laps = 1e3 * np.diff(ticks)
    warm = float(np.median(laps[1:])) / ROLLOUT_BLOCK if len(laps) > 1 else None
    stages.append(Stage("simulation", float(laps[0]), warm))
    return dict(zip([g.name for g in order], rollout.positions, strict=True))


def inside_shares(
    patch: SkinPatch, positions: np.ndarray, world: np.ndarray, shift: np.ndarray
) -> Float[np.ndarray, " frames"]:
    """Share of a garment's vertices below the skin near them, in every frame."""
    shares = []
    for start in range(0, len(positions), BLOCK):
        height = _heights(
            patch,
            padded_block(positions, start, 0),
            padded_block(world, start, 0),
            padded_block(shift, start, 0),
        )
        shares.append(np.asarray(height < 0)[: len(positions) - start].mean(axis=1))
    return np.concatenate(shares)


@jax.jit
def _heights(patch: SkinPatch, x: Array, r: Array, t: Array) -> Array:
    return each_frame(lambda p, a, b: skin_height(patch, p, a, b)[0], x, r, t)
