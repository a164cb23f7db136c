"""A dresser as one file that runs with jax alone, without this package."""

import hashlib
import json
import math
import pathlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import export

from ..data import CARD
from ..errors import MissingDependencyError, PhysXNetError
from ..files import whole_file
from ..io import read_card
from ._dresser import Dresser, clothe

EXPORTED = ("dresser.jaxexport", "garments.npz", "card.json", "dress.py")
"""Files of an export."""

_PLATFORMS = ("cpu", "cuda", "rocm", "tpu")

_LOADER = '''"""Clothes from joint rotations: needs jax, numpy and flatbuffers, nothing else.

>>> dress = load(".")                             # doctest: +SKIP
>>> cloth, ok = dress(rotations, root)            # doctest: +SKIP

rotations: [frames, joints, 4], unit quaternions wxyz relative to the parent joint; root:
[frames, 3] in metres, Y up; both float32, card.json names the joints and the rate that
frames must have. Returns a dictionary of vertices [frames, vertices, 3] in metres, and
which frames are finite; garments.npz holds the triangles. Any number of frames; each new
number compiles once.
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
    """Writes `clothe` of a dresser as StableHLO, for any number of frames.

    Args:
        folder: Where the files go, see `EXPORTED`.
        dresser: The clothes.
        fps: Frames a second that it will be asked for.
        platforms: What it will run on.
        name: Of the weights; their card's licence goes along.

    Returns:
        The files: the function, triangles, a card, and a loader that needs no more than
        jax, numpy and flatbuffers.

    Raises:
        MissingDependencyError: Without flatbuffers, by which jax writes exports.
        PhysXNetError: A platform that jax doesn't know, or a rate that isn't positive.
    """
    if not (math.isfinite(fps) and fps > 0):
        raise PhysXNetError(f"fps is {fps}, expected a positive number.")
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
        "garments": {w.name: int(w.rest.shape[0]) for w in dresser.wearables},
        "push_out": dresser.push_out,
        "asked_mirrored": dresser.predictor.mirrored,
        "relaxation_steps": dresser.predictor.relaxation,
        "weights": {k: v for k, v in read_card(name).items() if k != "measured"} if name else {},
        **CARD,
    }
    arrays: dict[str, np.ndarray] = {}
    for w, faces in zip(dresser.wearables, dresser.faces, strict=True):
        arrays[f"{w.name}_rest"] = np.asarray(w.rest)
        arrays[f"{w.name}_faces"] = np.asarray(faces)
    folder = pathlib.Path(folder)
    with whole_file(folder / EXPORTED[0]) as part:
        part.write_bytes(blob)
    with whole_file(folder / EXPORTED[1]) as part, part.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)
    with whole_file(folder / EXPORTED[2]) as part:
        part.write_text(json.dumps(card, indent=1) + "\n")
    with whole_file(folder / EXPORTED[3]) as part:
        part.write_text(_LOADER)
    return [folder / f for f in EXPORTED]
