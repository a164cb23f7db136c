"""Inference and penetration statistics over clips, in blocks of a fixed size."""

import dataclasses
import math
import pathlib
import time
from collections.abc import Iterator, Sequence

import jax
import numpy as np
from jaxtyping import Array, Float

from ..body import Body
from ..geometry import map_frames
from ..motion import BLOCK, Motion, clip_transforms, history_transforms, padded_block
from ..simulation import QUICK, Resume, fingerprint
from ._dresser import Dresser
from ._guided import init_guided
from ._pipeline import infer_block
from .postprocess import BodyCollider, Layer, resolve_layers, skin_clearance


@dataclasses.dataclass(frozen=True, kw_only=True)
class PosedClip:
    """A motion on a body shape, as joint transforms.

    Attributes:
        motion: The motion.
        rotations: World rotations of joints, shape [frames, joints, 3, 3].
        translations: World translations of joints [m], shape [frames, joints, 3].
        past: Frames of the same motion before the clip, if any.
    """

    motion: Motion
    rotations: Float[np.ndarray, "frames joints 3 3"]
    translations: Float[np.ndarray, "frames joints 3"]
    past: Motion | None = None

    @property
    def num_frames(self) -> int:
        """Number of frames."""
        return len(self.rotations)


def pose_clip(
    body: Body, rest: Float[Array, "all 3"], motion: Motion, past: Motion | None = None
) -> PosedClip:
    """Computes the joint transforms of a motion.

    Args:
        body: The body.
        rest: Its rest vertices [m].
        motion: The motion.
        past: Frames of the same motion before the clip, if known.
    """
    rotations, translations = clip_transforms(body, rest, motion)
    return PosedClip(motion=motion, rotations=rotations, translations=translations, past=past)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Block:
    """Successive frames of a dressed clip.

    Attributes:
        start: Index of the first frame.
        raw: Each garment by name before collision resolution [m], fine meshes at their sites,
            shape [frames, vertices, 3].
        positions: Each garment by name [m], shape [frames, vertices, 3].
        milliseconds: Time of the whole block, transfers included [ms]; NaN if an earlier run
            computed it.
    """

    start: int
    raw: dict[str, Float[np.ndarray, "frames _ 3"]]
    positions: dict[str, Float[np.ndarray, "frames vertices 3"]]
    milliseconds: float

    def moved(self, by: Float[np.ndarray, "3"]) -> "Block":
        """The block with all positions displaced [m]."""
        if not by.any():
            return self
        raw, positions = ({n: x + by for n, x in d.items()} for d in (self.raw, self.positions))
        return dataclasses.replace(self, raw=raw, positions=positions)


def infer_clip(
    dresser: Dresser, clip: PosedClip, resume: str | pathlib.Path | None = None
) -> Iterator[Block]:
    """Runs a dresser over a clip, one block at a time.

    Args:
        dresser: From `make_dresser`.
        clip: From `pose_clip`, on the dresser's body.
        resume: Folder for finished blocks, from which the same call goes on after an interruption;
            it is removed at the end. Blocks of another such call are removed.

    Yields:
        Blocks of at most `BLOCK` frames, in order.
    """
    history = dresser.history_length(clip.motion.fps)
    r, t = clip.rotations, clip.translations
    if history:
        before = history_transforms(dresser.body, dresser.rest, clip.motion, history, clip.past)
        r, t = (np.concatenate(pair) for pair in zip(before, (r, t), strict=True))
    names = [w.name for w in dresser.worn]
    state = None
    if dresser.guided is not None:
        # Here rather than in `infer`, so that all blocks are one program.
        state = init_guided(
            dresser.guided, jax.device_put(r[history - 1]), jax.device_put(t[history - 1])
        )
    store, done = None, 0
    if resume is not None:
        store = Resume(resume, QUICK + fingerprint(dresser, r, t, clip.motion.fps))
        for reached, arrays in store.blocks(state):
            state = reached
            yield _stored_block(BLOCK * done, names, arrays)
            done += 1
    for start in range(BLOCK * done, clip.num_frames, BLOCK):
        start_time = time.perf_counter()
        padded = (jax.device_put(padded_block(x, start + history, history)) for x in (r, t))
        *out, state = infer_block(dresser, *padded, clip.motion.fps, state)
        count = min(BLOCK, clip.num_frames - start)
        raw, cloth = (
            {n: np.asarray(x)[:count] for n, x in zip(names, part, strict=True)} for part in out
        )
        elapsed = 1e3 * (time.perf_counter() - start_time)
        if store is not None:
            arrays = {f"raw_{n}": x for n, x in raw.items()}
            arrays |= {f"cloth_{n}": x for n, x in cloth.items()}
            store.save(start // BLOCK, state, arrays)
        yield Block(start=start, raw=raw, positions=cloth, milliseconds=elapsed)
    if store is not None:
        store.finish()


def _stored_block(start: int, names: list[str], arrays: dict[str, np.ndarray]) -> Block:
    raw, cloth = ({n: arrays[f"{k}_{n}"] for n in names} for k in ("raw", "cloth"))
    return Block(start=start, raw=raw, positions=cloth, milliseconds=math.nan)


def inside_shares(
    collider: BodyCollider,
    positions: Float[np.ndarray, "frames vertices 3"],
    clip: PosedClip,
    start: int = 0,
) -> Float[np.ndarray, " frames"]:
    """Computes the share of a garment's vertices below the nearby skin, for each frame.

    Args:
        collider: The skin near the garment.
        positions: The garment [m].
        clip: The motion.
        start: Frame of the clip at which the positions start.
    """
    shares = []
    for at in range(0, len(positions), BLOCK):
        pose = (padded_block(x, start + at, 0) for x in (clip.rotations, clip.translations))
        height = _heights(collider, padded_block(positions, at, 0), *pose)
        shares.append(np.asarray(height < 0)[: len(positions) - at].mean(axis=1))
    return np.concatenate(shares)


@jax.jit
def _heights(collider: BodyCollider, x: Array, r: Array, t: Array) -> Array:
    return map_frames(lambda p, a, b: skin_clearance(collider, p, a, b)[0], x, r, t)


def resolve_clip_layers(
    layers: Sequence[Layer], positions: dict[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """Resolves layers over all frames of a clip; positions in [m]."""
    if not layers:
        return positions
    frames = len(next(iter(positions.values())))
    blocks = []
    for at in range(0, frames, BLOCK):
        cloth = tuple(jax.device_put(padded_block(x, at, 0)) for x in positions.values())
        blocks.append([np.asarray(x) for x in _resolve_block(tuple(layers), cloth)])
    return {n: np.concatenate([b[k] for b in blocks])[:frames] for k, n in enumerate(positions)}


@jax.jit
def _resolve_block(layers: tuple[Layer, ...], cloth: tuple[Array, ...]) -> tuple[Array, ...]:
    return resolve_layers(layers, cloth)
