"""Training frames in memory."""

import dataclasses
import hashlib
from collections.abc import Iterable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..body import Body
from ..errors import FormatError
from ..garment import Garment
from ..geometry import polar_rotation
from ..motion import clip_transforms
from ..simulation import OFF
from ._store import QUANTIZATION_STEP, Sequence
from ._wardrobe import Wardrobe

# Largest usable offsets from skinning [m]. Beyond the first, a sleeve or trouser leg is off its
# limb. Skirts may swing further; beyond the second, they have come off. Targets must also fit
# int16 in units of 0.1 mm.
MAX_OFFSET, MAX_SKIRT = 0.5, 3.0


def pose_windows(
    values: Float[Array, "frames ..."] | Float[np.ndarray, "frames ..."], window: int
) -> Float[Array, "frames window ..."] | Float[np.ndarray, "frames window ..."]:
    """The window of poses up to each frame; the first pose is repeated before frame 0."""
    frames = values.shape[0]
    index = np.arange(frames)[:, None] + np.arange(1 - window, 1)[None]
    return values[np.maximum(index, 0)]


# Cloth this deep in the body [m] has come off: such a sequence isn't used for training.
MAX_PENETRATION = 0.1


_CHUNK = 16


@dataclasses.dataclass(frozen=True)
class Frames:
    """Training frames in memory.

    Attributes:
        rotations: World rotations of joints over each frame's window, shape
            [frames, window, joints, 3, 3].
        translations: World translations [m], shape [frames, window, joints, 3].
        targets: For each template, cloth offsets [0.1 mm], shape [frames, vertices, 3].
        usable: For each template, which frames are usable, shape [frames].
        fps: Frames per second.
        garment: For each template the garment's number in the wardrobe, shape [frames].
        person: The person's number there, shape [frames].
    """

    rotations: Float[np.ndarray, "frames window joints 3 3"]
    translations: Float[np.ndarray, "frames window joints 3"]
    targets: dict[str, np.ndarray]
    usable: dict[str, Bool[np.ndarray, " frames"]]
    fps: float
    garment: dict[str, Int[np.ndarray, " frames"]] = dataclasses.field(default_factory=dict)
    person: Int[np.ndarray, " frames"] | None = None

    def __len__(self) -> int:
        return len(self.rotations)


def usable_garment(meta: dict) -> bool:
    """Whether a simulated garment stayed on the body."""
    worst = meta["worst"]
    inside = worst.get("penetration_max", 0.0) <= MAX_PENETRATION
    return bool(meta["finite"]) and inside and worst.get("slipped", 0.0) <= OFF


def is_trainable(sequence: Sequence, name: str) -> bool:
    """Whether a simulated garment is usable for training: it stayed on the body and its limbs."""
    if name not in sequence.offsets or not usable_garment(sequence.meta[name]):
        return False
    most = MAX_SKIRT if name == "dress" else MAX_OFFSET
    return bool((np.linalg.norm(sequence.offsets[name], axis=2) <= most).all())


def load_frames(
    sequences: Iterable[Sequence],
    wardrobe: Wardrobe,
    body: Body,
    *,
    window: int,
    local: bool,
) -> Frames:
    """Pose windows and cloth targets of all sequences, in a single pass over them.

    Targets are cloth offsets in the family's frame. For ``local``: cloth minus its
    skinning, in each cloth vertex's own frame. For ``paper``: cloth positions relative to
    their skinning in the world frame (the skin is subtracted at the texels). Garments with fewer
    vertices than the largest of their template are padded with zeros.

    Raises:
        FormatError: No sequences, or sequences of different frame rates.
    """
    rotations, translations = [], []
    rates: set[float] = set()
    names, rests = wardrobe.garments, wardrobe.rests()
    targets: dict[str, list] = {t: [] for t in names}
    usable: dict[str, list] = {t: [] for t in names}
    garment: dict[str, list] = {t: [] for t in names}
    persons = []
    for s in sequences:
        rates.add(s.motion.fps)
        if len(rates) != 1:
            raise FormatError(f"sequences of different frame rates: {sorted(rates)}.")
        person = wardrobe.person(s.outfit)
        world, shift = clip_transforms(body, rests[person], s.motion)
        persons.append(np.full(len(world), person, np.int32))
        rotations.append(np.asarray(pose_windows(world, window)))
        translations.append(np.asarray(pose_windows(shift, window)))
        for name in names:
            trainable = is_trainable(s, name)
            usable[name].append(np.full(len(world), trainable))
            number = wardrobe.numbers.get((name, s.outfit), 0)
            garment[name].append(np.full(len(world), number, np.int32))
            target = np.zeros((len(world), wardrobe.num_vertices(name), 3), dtype=np.int16)
            targets[name].append(target)
            if not trainable:
                continue
            offset = s.offsets[name]
            if local:
                offset = _to_local(s.garment(name), world, offset)
            target[:, : offset.shape[1]] = np.round(offset / QUANTIZATION_STEP)
    if not rotations:
        raise FormatError("no sequence to train on; build a dataset first.")
    cat = np.concatenate
    return Frames(
        cat(rotations),
        cat(translations),
        # Targets take gigabytes: parts are released as soon as they are concatenated.
        {t: cat(targets.pop(t)) for t in names},
        {t: cat(v) for t, v in usable.items()},
        rates.pop(),
        {t: cat(v) for t, v in garment.items()},
        cat(persons),
    )


def content_hash(meta: Mapping[str, Any], offsets: Mapping[str, np.ndarray] | None) -> str:
    """A short hash of an action's cloth, from the dataset's checksums where it stores them."""
    digest = hashlib.sha256()
    for name in sorted(meta if offsets is None else offsets):
        known = meta[name].get("sha256")
        if known is None and offsets is not None:
            known = hashlib.sha256(offsets[name].tobytes()).hexdigest()
        digest.update(f"{name} {known}\n".encode())
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


def take(frames: Frames, index: np.ndarray) -> dict[str, np.ndarray]:
    """The arrays of one batch."""
    out = {
        "rotations": frames.rotations[index],
        "translations": frames.translations[index],
    }
    if frames.person is not None:
        out["person"] = frames.person[index]
    for t in frames.targets:
        out[f"target_{t}"] = frames.targets[t][index]
        out[f"weight_{t}"] = frames.usable[t][index].astype(np.float32)
        if t in frames.garment:
            out[f"garment_{t}"] = frames.garment[t][index]
    return out
