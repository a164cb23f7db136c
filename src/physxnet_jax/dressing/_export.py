"""Exports a dresser as a serialised JAX function that runs without this package."""

import hashlib
import json
import pathlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import export

from ..data import CARD
from ..errors import MissingDependencyError, PhysXNetError, check_rate
from ..files import atomic_write
from ..models import read_card
from ._clothe import clothe
from ._dresser import Dresser

EXPORTED = ("dresser.jaxexport", "garments.npz", "card.json", "dress.py")
"""Files of an export."""

_PLATFORMS = ("cpu", "cuda", "rocm", "tpu")

_LOADER = '''"""Garments from joint rotations; needs only jax, numpy and flatbuffers.

>>> dress = load(".")                             # doctest: +SKIP
>>> cloth, ok = dress(rotations, root)            # doctest: +SKIP

rotations: [frames, joints, 4], unit quaternions wxyz relative to the parent joint; root:
[frames, 3] in metres, Y up; both float32. card.json lists the joints and the required
frame rate. Returns a dictionary of vertices [frames, vertices, 3] in metres, and which
frames are finite. garments.npz holds the triangles. The number of frames is arbitrary;
each new number compiles once.
"""

import hashlib
import json
import pathlib

import jax
from jax import export


def load(folder):
    folder = pathlib.Path(folder)
    card = json.loads((folder / "card.json").read_text())
    blob = (folder / "dresser.jaxexport").read_bytes()
    if hashlib.sha256(blob).hexdigest() != card["sha256"]:
        raise ValueError(f"{folder}: dresser.jaxexport is damaged; export it again.")
    return jax.jit(export.deserialize(bytearray(blob)).call)
'''


def export_dresser(
    folder: str | pathlib.Path,
    dresser: Dresser,
    *,
    fps: float = 30.0,
    platforms: tuple[str, ...] = ("cpu", "cuda"),
    name: str = "",
) -> list[pathlib.Path]:
    """Exports `clothe` of a dresser as StableHLO, for any number of frames.

    Args:
        folder: Output folder for the files `EXPORTED`.
        dresser: The dresser.
        fps: Frames per second of the exported function.
        platforms: Target platforms.
        name: Name of the weights, whose card and licence are included.

    Returns:
        The files: the function, triangles, a card, and a loader that needs only jax, numpy
        and flatbuffers.

    Raises:
        MissingDependencyError: flatbuffers isn't installed, which jax needs for exports.
        PhysXNetError: A platform is unknown, or the frame rate isn't positive.
    """
    check_rate(fps)
    unknown = set(platforms) - set(_PLATFORMS)
    if unknown or not platforms:
        raise PhysXNetError(
            f"no platform '{', '.join(sorted(unknown))}'; there are {', '.join(_PLATFORMS)}."
        )
    try:
        import flatbuffers  # noqa: F401
    except ImportError as error:
        raise MissingDependencyError(
            "Exports need flatbuffers: pip install 'physxnet-jax[export]'."
        ) from error
    (frames,) = export.symbolic_shape("frames")
    joints = len(dresser.body.joint_names)
    shapes = [jax.ShapeDtypeStruct((frames, *rest), jnp.float32) for rest in ((joints, 4), (3,))]

    def whole(rotations: Any, root: Any) -> Any:
        clothed = clothe(dresser, rotations, root, fps)
        return clothed.vertices, clothed.ok

    blob = bytes(export.export(jax.jit(whole), platforms=platforms)(*shapes).serialize())
    card = {
        "sha256": hashlib.sha256(blob).hexdigest(),
        "jax": jax.__version__,
        "platforms": list(platforms),
        "fps": fps,
        "joints": list(dresser.body.joint_names),
        "rotations": "unit quaternions wxyz relative to the parent, [frames, joints, 4]",
        "root": "position of the first joint, metres, Y up, [frames, 3]",
        "garments": {w.name: int(w.rest.shape[0]) for w in dresser.worn},
        "collisions": dresser.colliders is not None,
        "tta": dresser.predictor is not None and dresser.predictor.mirror_tta,
        "strain_iterations": 0 if dresser.strain is None else dresser.strain.iterations,
        "weights": {k: v for k, v in read_card(name).items() if k != "measured"} if name else {},
        **CARD,
    }
    arrays: dict[str, np.ndarray] = {}
    for w, faces in zip(dresser.worn, dresser.faces, strict=True):
        arrays[f"{w.name}_rest"] = np.asarray(w.rest)
        arrays[f"{w.name}_faces"] = np.asarray(faces)
    folder = pathlib.Path(folder)
    with atomic_write(folder / EXPORTED[0]) as part:
        part.write_bytes(blob)
    with atomic_write(folder / EXPORTED[1]) as part, part.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)
    with atomic_write(folder / EXPORTED[2]) as part:
        part.write_text(json.dumps(card, indent=1) + "\n")
    with atomic_write(folder / EXPORTED[3]) as part:
        part.write_text(_LOADER)
    return [folder / f for f in EXPORTED]
