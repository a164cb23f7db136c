"""Training frames in memory, and batches that a step number alone decides."""

import dataclasses
import hashlib
from collections.abc import Iterable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..body import Body
from ..data import QUANTUM, Sequence
from ..errors import FormatError
from ..garment import Garment
from ..geometry import polar_rotation
from ..models import (
    PAPER,
    Family,
    Inputs,
    Normalisation,
    Surface,
    clip_features,
    pose_windows,
    skin_points,
)
from ..motion import clip_transforms
from ..uv import Transference

# A cloth this deep in the body has come off: such a sequence teaches nothing.
MAX_PENETRATION = 0.1
# Sleeves and trouser legs this far from their skinning have lost their limb [m]. Skirts may be,
# but one this far has come off, and targets have sixteen bits of a tenth of a millimetre.
MAX_OFFSET, MAX_SKIRT = 0.5, 3.0
_CHUNK = 16


@dataclasses.dataclass(frozen=True)
class Frames:
    """All training frames.

    Attributes:
        rotations: World rotations of joints of each frame's window, shape
            [frames, window, joints, 3, 3].
        translations: World translations [m], shape [frames, window, joints, 3].
        targets: For each template, cloth offsets [0.1 mm], shape [frames, vertices, 3].
        usable: For each template, which frames count, shape [frames].
        fps: Frames a second.
        identity: Names, lengths and contents of the sequences: a run is tied to its data.
    """

    rotations: Float[np.ndarray, "frames window joints 3 3"]
    translations: Float[np.ndarray, "frames window joints 3"]
    targets: dict[str, np.ndarray]
    usable: dict[str, Bool[np.ndarray, " frames"]]
    fps: float
    identity: str

    def __len__(self) -> int:
        return len(self.rotations)


def usable_garment(meta: dict) -> bool:
    """Whether a simulated garment stayed on the body."""
    # What a network answered wasn't measured: it can't come off.
    return bool(meta["finite"]) and meta["worst"].get("penetration_max", 0.0) <= MAX_PENETRATION


def teaches(sequence: Sequence, name: str) -> bool:
    """Whether a simulated garment is one to learn from: it stayed on the body and its limbs."""
    if name not in sequence.offsets or not usable_garment(sequence.meta[name]):
        return False
    most = MAX_SKIRT if name == "dress" else MAX_OFFSET
    return bool((np.linalg.norm(sequence.offsets[name], axis=2) <= most).all())


def load_frames(
    sequences: Iterable[Sequence],
    garments: dict[str, Garment],
    body: Body,
    rest: Float[Array, "all 3"],
    inputs: Inputs,
) -> Frames:
    """Windows of poses and cloth targets of all sequences, each looked at once.

    Targets are cloth offsets in the family's frame: for ``local``, cloth minus its
    skinning, in each cloth vertex's own frame; for ``paper``, cloth positions relative
    to their skinning in the world's frame (the skin is subtracted at the texels).

    Raises:
        FormatError: Sequences of different rates, or none.
    """
    rotations, translations, told = [], [], []
    rates: set[float] = set()
    targets: dict[str, list] = {t: [] for t in garments}
    usable: dict[str, list] = {t: [] for t in garments}
    for s in sequences:
        rates.add(s.motion.fps)
        if len(rates) != 1:
            raise FormatError(f"sequences of different frame rates: {sorted(rates)}.")
        told.append(f"{s.name} {s.motion.num_frames} {_content(s)}")
        world, shift = clip_transforms(body, rest, s.motion)
        rotations.append(np.asarray(pose_windows(world, inputs)))
        translations.append(np.asarray(pose_windows(shift, inputs)))
        for name, g in garments.items():
            have = teaches(s, name)
            usable[name].append(np.full(len(world), have))
            if not have:
                targets[name].append(np.zeros((len(world), g.num_vertices, 3), dtype=np.int16))
                continue
            offset = s.offsets[name]
            if inputs.family == "local":
                offset = _to_local(g, world, offset)
            targets[name].append(np.round(offset / QUANTUM).astype(np.int16))
    if not told:
        raise FormatError("no sequence to train on; build a dataset first.")
    cat = np.concatenate
    return Frames(
        cat(rotations),
        cat(translations),
        # These are gigabytes: what is joined is let go of.
        {t: cat(targets.pop(t)) for t in garments},
        {t: cat(v) for t, v in usable.items()},
        rates.pop(),
        ", ".join(told),
    )


def _content(sequence: Sequence) -> str:
    """A short hash of a sequence's cloth: what a dataset noted, the same on every machine."""
    digest = hashlib.sha256()
    for name, offsets in sorted(sequence.offsets.items()):
        told = sequence.meta[name].get("sha256")
        told = hashlib.sha256(offsets.tobytes()).hexdigest() if told is None else told
        digest.update(f"{name} {told}\n".encode())
    return digest.hexdigest()[:8]


def _to_local(
    garment: Garment, world: np.ndarray, offset: np.ndarray
) -> Float[np.ndarray, "frames vertices 3"]:
    frames = len(world)
    pick = np.minimum(np.arange(-(-frames // _CHUNK) * _CHUNK), frames - 1)
    out = [
        np.asarray(
            _rotate_back(garment.skin, world[pick[i : i + _CHUNK]], offset[pick[i : i + _CHUNK]])
        )
        for i in range(0, len(pick), _CHUNK)
    ]
    return np.concatenate(out)[:frames]


@jax.jit
def _rotate_back(skin: Array, world: Array, offset: Array) -> Array:
    def one(r: Array, o: Array) -> Array:
        blend = jnp.matmul(skin, r.reshape(-1, 9), precision=jax.lax.Precision.HIGHEST).reshape(
            -1, 3, 3
        )
        return jnp.einsum(
            "vba,vb->va", polar_rotation(blend), o, precision=jax.lax.Precision.HIGHEST
        )

    return jax.vmap(one)(world, offset)


def batch_indices(num_frames: int, batch: int, seed: int, step: int) -> np.ndarray:
    """Frames of a step: a fresh permutation every epoch, decided by the step alone."""
    per_epoch = max(num_frames // batch, 1)
    epoch, at = divmod(step, per_epoch)
    order = np.random.default_rng([seed, epoch]).permutation(num_frames)
    return np.resize(order[at * batch : (at + 1) * batch], batch)


def take(frames: Frames, index: np.ndarray) -> dict[str, np.ndarray]:
    """One batch as arrays."""
    out = {
        "rotations": frames.rotations[index],
        "translations": frames.translations[index],
    }
    for t in frames.targets:
        out[f"target_{t}"] = frames.targets[t][index]
        out[f"weight_{t}"] = frames.usable[t][index].astype(np.float32)
    return out


def target_offsets(
    target: Array,
    to_cloth: Transference,
    garment_rest: Array,
    skin: Array,
    anchor: Array,
    anchor_weights: Array,
    rotations: Array,
    translations: Array,
    family: Family,
) -> Float[Array, "batch texels 3"]:
    """Targets at texels [m] from stored vertex offsets.

    ``paper`` adds back the skinning and subtracts the skin at the texel (I_C of
    equation 9); ``local`` needs neither.
    """
    offset = target.astype(jnp.float32) * QUANTUM
    if family == "local":
        return to_cloth @ offset

    def one(o: Array, r: Array, t: Array) -> Array:
        cloth = skin_points(garment_rest, skin, r, t)[0] + o
        return to_cloth @ cloth - skin_points(anchor, anchor_weights, r, t)[0]

    return jax.vmap(one)(offset, rotations, translations)


def measure_normalisation(
    frames: Frames,
    surface: Surface,
    offsets_of: dict[str, Array],
    *,
    samples: int = 128,
    seed: int = 0,
) -> Normalisation:
    """Scales from a sample of the training frames: 99.9 % of values lie in [-1, 1].

    Args:
        frames: Training frames.
        surface: Texels.
        offsets_of: Target offsets of sampled frames for each template [m].
        samples: Frames looked at.
        seed: Of the sample.

    Note (differs from the paper):
        A percentile instead of the largest value: one fast hand in one frame would
        otherwise squeeze every other motion into a few per cent of the range.
    """
    pick = np.random.default_rng(seed).choice(len(frames), min(samples, len(frames)), False)
    look = jax.jit(clip_features, static_argnames=("fps", "inputs"))
    # World axes, whatever the network is told in: close enough for a scale.
    seen = dataclasses.replace(PAPER, frames=1)
    rows = [
        np.abs(
            look(
                surface.rest,
                surface.weights,
                frames.rotations[i, -seen.window :],
                frames.translations[i, -seen.window :],
                fps=frames.fps,
                inputs=seen,
            )[0]
        )
        for i in pick
    ]
    features = np.stack(rows)

    def scale(x: np.ndarray) -> Array:
        return jnp.asarray(max(float(np.quantile(x, 0.999)), 1e-6), jnp.float32)

    return Normalisation(
        scale(features[..., :3]),
        scale(features[..., 3:6]),
        {t: scale(np.abs(np.asarray(o))) for t, o in offsets_of.items()},
    )
