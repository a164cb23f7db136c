"""Simulated actions on disk: zarr arrays through tensorstore, one folder per action.

``dataset.json`` describes the dataset, ``garments/`` holds each garment once, and every
action's folder holds the motion and one array per garment. The body follows from the motion.
"""

import contextlib
import dataclasses
import functools
import hashlib
import json
import math
import os
import pathlib
import shutil
from collections.abc import Iterator
from typing import Any

import numpy as np
import tensorstore as ts
from jaxtyping import Float, Int

from ..errors import FormatError
from ..files import append_line, atomic_write, read_arrays, read_lines
from ..motion import Motion, load_motion, save_motion
from ._codec import Codec, make_codec

# Offsets are rounded to tenths of a millimetre: the error is at most 0.05 mm.
QUANTIZATION_STEP = 1e-4
_MAX_OFFSET = 3.2
# Largest number of coordinates that are read for one garment in one action.
_MAX_COORDINATES = 3e8
_NOTE = "dataset.json"
# Timings differ between runs: the log isn't part of the dataset's digest.
_LOG = "build_log.jsonl"


@dataclasses.dataclass(frozen=True)
class Sequence:
    """One simulated action.

    Attributes:
        name: Name of the action.
        split: ``train``, ``test`` or ``extra``.
        motion: The body's motion.
        offsets: For each template, cloth minus its linear blend skinning [m], shape
            [frames, vertices, 3].
        meta: Further metadata of each template: engine, settings, diagnostics.
    """

    name: str
    split: str
    motion: Motion
    offsets: dict[str, Float[np.ndarray, "frames vertices 3"]]
    meta: dict[str, Any]


def open_dataset(root: str | pathlib.Path, note: dict[str, Any]) -> None:
    """Creates a dataset, or checks that the existing one has the same configuration.

    Raises:
        FormatError: The folder holds another dataset.
    """
    path = pathlib.Path(root) / _NOTE
    text = json.dumps(note, indent=1, sort_keys=True)
    if path.is_file():
        if read_note(root) != json.loads(text):
            raise FormatError(
                f"{root}: the folder holds a dataset of another configuration. Choose another"
                " folder or delete it."
            )
        return
    with atomic_write(path) as part:
        part.write_text(text)


def read_note(root: str | pathlib.Path) -> dict[str, Any]:
    """The settings that a dataset stores about itself.

    Raises:
        FormatError: The file is missing or damaged.
    """
    path = pathlib.Path(root) / _NOTE
    if not path.is_file():
        raise FormatError(f"{root}: no {_NOTE}, not a dataset; build one first.")
    with _report_damage(path):
        return _as_dict(json.loads(path.read_text()))


def _as_dict(parsed: object) -> dict[str, Any]:
    if not isinstance(parsed, dict):
        raise TypeError("not a table")
    return parsed


def write_garment(
    root: str | pathlib.Path,
    name: str,
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
) -> None:
    """Stores a garment at rest [m] and the codec of its offsets, once.

    Raises:
        FormatError: Another garment is stored under that name, or it has too many vertices.
    """
    path = pathlib.Path(root) / "garments" / f"{name}.npz"
    if path.is_file():
        stored = _archive(path)
        if not (
            np.array_equal(stored["faces"], faces)
            and np.allclose(stored["vertices"], vertices, atol=1e-5)
        ):
            raise FormatError(
                f"{path}: another garment of that name is stored there, and existing offsets are"
                " coded with it. Choose another folder, or delete it."
            )
        return
    if len(vertices) > np.iinfo(np.int16).max:
        raise FormatError(
            f"{name}: {len(vertices):,} vertices; a dataset's garments have 32,767 at most."
        )
    codec = make_codec(vertices, faces)
    with atomic_write(path) as part:
        np.savez_compressed(
            part,
            vertices=np.asarray(vertices, np.float32),
            faces=np.asarray(faces, np.int32),
            order=codec.order.astype(np.int16),
            parents=codec.parents.astype(np.int16),
            weights=codec.weights.astype(np.int16),
        )


@functools.lru_cache(maxsize=8)
def _codec(path: pathlib.Path, changed: int) -> Codec:
    data = _archive(path)
    return Codec(*(data[k].astype(np.int64) for k in ("order", "parents", "weights")))


def _archive(path: pathlib.Path) -> dict[str, np.ndarray]:
    names = ("vertices", "faces", "order", "parents", "weights")
    with _report_damage(path):
        data = read_arrays(path, names)
        data = {name: data[name] for name in names}
        count = len(data["vertices"])
        integers = [data[k] for k in ("faces", "order", "parents", "weights")]
        if data["vertices"].dtype.kind != "f" or any(x.dtype.kind not in "iu" for x in integers):
            raise TypeError("unexpected data types")
        shapes = (data["parents"].shape, data["weights"].shape)
        if shapes[0] != shapes[1] or len(shapes[0]) != 2 or shapes[0][0] != count:
            raise ValueError("unexpected shapes")
        indices = (data["parents"], data["faces"], data["order"])
        if any(x.min(initial=0) < 0 or x.max(initial=0) >= count for x in indices):
            raise ValueError("vertex indices out of range")
        if not np.array_equal(np.sort(data["order"]), np.arange(count)):
            raise ValueError("order isn't a permutation of the vertices")
        return data


@contextlib.contextmanager
def _report_damage(path: pathlib.Path) -> Iterator[None]:
    """Converts errors of a damaged file to `FormatError`."""
    try:
        yield
    except FormatError:
        raise
    except (ValueError, LookupError, TypeError, OSError, RecursionError) as error:
        raise FormatError(
            f"{path}: damaged ({type(error).__name__}). Delete its folder and build the dataset"
            " again: only this part will be simulated."
        ) from error


def _codec_of(folder: pathlib.Path, template: str) -> Codec:
    path = folder.parent / "garments" / f"{template}.npz"
    if not path.is_file():
        raise FormatError(f"{path}: missing; {folder.name}/{template} needs this garment.")
    return _codec(path.absolute(), path.stat().st_mtime_ns)


def write_offsets(
    folder: pathlib.Path,
    template: str,
    offsets: Float[np.ndarray, "frames vertices 3"],
    meta: dict[str, Any],
) -> None:
    """Writes the offsets of one garment in one action, atomically.

    Args:
        folder: The action's folder.
        template: Name of the garment; `write_garment` stored it.
        offsets: Cloth minus skinning [m].
        meta: Stored as attributes of the array.

    Raises:
        FormatError: An offset isn't finite or exceeds the 3.2 m that can be stored: the
            simulation diverged.
    """
    integers = np.round(offsets / QUANTIZATION_STEP)
    if not np.isfinite(integers).all() or np.abs(integers).max() > _MAX_OFFSET / QUANTIZATION_STEP:
        raise FormatError(
            f"{folder.name}/{template}: cloth is more than {_MAX_OFFSET} m from the body or not"
            " finite; simulate it again with more substeps."
        )
    residuals = _codec_of(folder, template).encode(integers.astype(np.int64))
    part = folder / f".{template}.part"
    shutil.rmtree(part, ignore_errors=True)
    store = ts.open(
        {
            "driver": "zarr3",
            "kvstore": {"driver": "file", "path": str(part)},
            "metadata": {
                "shape": list(residuals.shape),
                "data_type": "uint32",
                "chunk_grid": {
                    "name": "regular",
                    "configuration": {"chunk_shape": list(residuals.shape)},
                },
                "codecs": [
                    {"name": "bytes", "configuration": {"endian": "little"}},
                    {
                        "name": "blosc",
                        "configuration": {
                            "cname": "zstd",
                            "clevel": 9,
                            "shuffle": "shuffle",
                            "typesize": 4,
                        },
                    },
                ],
                "attributes": {
                    **meta,
                    "unit": "m",
                    "quantum": QUANTIZATION_STEP,
                    "frames": len(offsets),
                    "sha256": hashlib.sha256(residuals.tobytes()).hexdigest(),
                },
            },
        },
        create=True,
    ).result()
    store.write(residuals).result()
    final = folder / template
    shutil.rmtree(final, ignore_errors=True)
    os.replace(part, final)


def read_offsets(folder: pathlib.Path, template: str) -> Float[np.ndarray, "frames vertices 3"]:
    """Offsets [m] of one garment in one action.

    Raises:
        FormatError: The array is damaged.
    """
    path = folder / template
    codec, frames = _codec_of(folder, template), read_meta(folder, template).get("frames")
    with _report_damage(path):
        spec = {"driver": "zarr3", "kvstore": {"driver": "file", "path": str(path)}}
        store = ts.open(spec, read=True).result()
        # Checked before allocation: a kilobyte on disk may declare gigabytes of zeros.
        fits = store.shape == (3, len(codec.order), frames) and store.dtype == ts.uint32
        if not fits or math.prod(store.shape) > _MAX_COORDINATES:
            raise ValueError("unexpected shape or data type")
        residuals = np.ascontiguousarray(store.read().result())
    if hashlib.sha256(residuals.tobytes()).hexdigest() != read_meta(folder, template).get("sha256"):
        raise FormatError(
            f"{folder.name}/{template}: the checksum is wrong; delete that folder and build"
            " the dataset again, only this part will be simulated."
        )
    return codec.decode(residuals).astype(np.float32) * np.float32(QUANTIZATION_STEP)


def read_meta(folder: pathlib.Path, template: str) -> dict[str, Any]:
    """Metadata of one garment in one action.

    Raises:
        FormatError: The metadata is damaged.
    """
    path = folder / template / "zarr.json"
    with _report_damage(path):
        return _as_dict(_as_dict(json.loads(path.read_text()))["attributes"])


def is_stored(folder: pathlib.Path, template: str) -> bool:
    """Whether a garment of an action is stored."""
    return (folder / template / "zarr.json").is_file()


def write_action(folder: pathlib.Path, motion: Motion, split: str) -> None:
    """Writes the motion of an action and its split.

    Raises:
        FormatError: The folder holds another motion, which its garments belong to, or another
            split.
    """
    folder.mkdir(parents=True, exist_ok=True)
    motion_file = folder / "motion.npz"
    if motion_file.is_file():
        stored = load_motion(motion_file)
        pairs = ((stored.rotations, motion.rotations), (stored.root, motion.root))
        same = all(a.shape == b.shape and np.allclose(a, b, atol=1e-4) for a, b in pairs)
        if not same or stored.fps != motion.fps:
            raise FormatError(
                f"{folder}: its motion isn't the one to simulate: it comes from other files or"
                " another version. Delete that folder, or build into another one."
            )
    else:
        save_motion(motion_file, motion)
    note = folder / "action.json"
    if note.is_file() and _action_note(note)["split"] != split:
        raise FormatError(
            f"{folder}: stored as '{_action_note(note)['split']}', now '{split}'. A"
            " dataset whose splits changed must be rebuilt: choose another folder."
        )
    with atomic_write(note) as part:
        part.write_text(json.dumps({"name": motion.name, "split": split}))


def read_sequence(folder: str | pathlib.Path) -> Sequence:
    """Reads an action with every garment that has been simulated for it.

    Raises:
        FormatError: The folder doesn't hold an action.
    """
    folder = pathlib.Path(folder)
    note = folder / "action.json"
    if not note.is_file():
        raise FormatError(f"{folder}: no action.json, not an action of a dataset.")
    info = _action_note(note)
    motion = load_motion(folder / "motion.npz")
    # Names that begin with a dot are incomplete: in progress or interrupted.
    found = sorted(p.parent.name for p in folder.glob("[!.]*/zarr.json"))
    return Sequence(
        info["name"],
        info["split"],
        Motion(motion.rotations, motion.root, motion.fps, info["name"]),
        {name: read_offsets(folder, name) for name in found},
        {name: read_meta(folder, name) for name in found},
    )


def list_sequences(root: str | pathlib.Path, split: str | None = None) -> list[pathlib.Path]:
    """Folders of a dataset's actions, sorted, optionally of one split."""
    out = []
    for note in sorted(pathlib.Path(root).glob("*/action.json")):
        if split is None or _action_note(note)["split"] == split:
            out.append(note.parent)
    return out


def _action_note(path: pathlib.Path) -> dict[str, str]:
    with _report_damage(path):
        parsed = json.loads(path.read_text())
        return {"name": str(parsed["name"]), "split": str(parsed["split"])}


def log_build(root: str | pathlib.Path, line: dict[str, Any]) -> None:
    """Appends a line to the build log: a job and its duration."""
    append_line(pathlib.Path(root) / _LOG, line)


def read_log(root: str | pathlib.Path) -> list[dict[str, Any]]:
    """The lines of the build log; incomplete lines are dropped."""
    return read_lines(pathlib.Path(root) / _LOG)


def _unfinished(path: pathlib.Path) -> bool:
    return any(part.startswith(".") for part in path.parts)


def dataset_digest(root: str | pathlib.Path) -> tuple[str, int]:
    """Checksum of a dataset's files (build log excluded), and their size in bytes."""
    root = pathlib.Path(root)
    total, size = hashlib.sha256(), 0
    files = (p for p in root.rglob("*") if p.is_file() and p.name != _LOG)
    for path in sorted(p for p in files if not _unfinished(p.relative_to(root))):
        blob = path.read_bytes()
        size += len(blob)
        total.update(f"{path.relative_to(root)} {hashlib.sha256(blob).hexdigest()}\n".encode())
    return total.hexdigest(), size
