"""Simulated actions on disk: zarr arrays through tensorstore, one folder an action.

``dataset.json`` tells what the set is, ``garments/`` holds each garment once, and every
action's folder the motion and an array for each garment. The body follows from the motion.
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
from ..files import append_line, read_arrays, read_lines, whole_file
from ..motion import Motion, load_motion, save_motion
from ._codec import Codec, make_codec

# Offsets are stored as whole tenths of a millimetre: the error is at most 0.05 mm.
QUANTUM = 1e-4
_LARGEST = 3.2
# Coordinates of a garment in an action that are read at most.
_MOST = 3e8
_NOTE = "dataset.json"
# Times differ from run to run: they are no part of what a dataset is.
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
        meta: What else was noted of each: engine, settings, diagnostics.
    """

    name: str
    split: str
    motion: Motion
    offsets: dict[str, Float[np.ndarray, "frames vertices 3"]]
    meta: dict[str, Any]


def open_dataset(root: str | pathlib.Path, note: dict[str, Any]) -> None:
    """Begins a dataset, or makes sure that the one there is the same.

    Raises:
        FormatError: Another dataset lies there.
    """
    path = pathlib.Path(root) / _NOTE
    text = json.dumps(note, indent=1, sort_keys=True)
    if path.is_file():
        if read_note(root) != json.loads(text):
            raise FormatError(
                f"{root}: a dataset of another configuration lies there. Choose another"
                " folder or delete it."
            )
        return
    with whole_file(path) as part:
        part.write_text(text)


def read_note(root: str | pathlib.Path) -> dict[str, Any]:
    """What a dataset says of itself.

    Raises:
        FormatError: There is none.
    """
    path = pathlib.Path(root) / _NOTE
    if not path.is_file():
        raise FormatError(f"{root}: no {_NOTE}, not a dataset; build one first.")
    with _damage_told(path):
        return _table(json.loads(path.read_text()))


def _table(told: object) -> dict[str, Any]:
    if not isinstance(told, dict):
        raise TypeError("not a table")
    return told


def write_garment(
    root: str | pathlib.Path,
    name: str,
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
) -> None:
    """Stores a garment at rest [m] and how its offsets are coded, once.

    Raises:
        FormatError: Another garment lies there under that name, or one of too many vertices.
    """
    path = pathlib.Path(root) / "garments" / f"{name}.npz"
    if path.is_file():
        before = _archive(path)
        if not (
            np.array_equal(before["faces"], faces)
            and np.allclose(before["vertices"], vertices, atol=1e-5)
        ):
            raise FormatError(
                f"{path}: another garment of that name lies there; what is stored was told from"
                " it. Choose another folder, or delete it."
            )
        return
    if len(vertices) > np.iinfo(np.int16).max:
        raise FormatError(
            f"{name}: {len(vertices):,} vertices; a dataset's garments have 32,767 at most."
        )
    codec = make_codec(vertices, faces)
    with whole_file(path) as part:
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
    with _damage_told(path):
        data = read_arrays(path, names)
        data = {name: data[name] for name in names}
        count = len(data["vertices"])
        whole = [data[k] for k in ("faces", "order", "parents", "weights")]
        if data["vertices"].dtype.kind != "f" or any(x.dtype.kind not in "iu" for x in whole):
            raise TypeError("arrays of other kinds")
        shapes = (data["parents"].shape, data["weights"].shape)
        if shapes[0] != shapes[1] or len(shapes[0]) != 2 or shapes[0][0] != count:
            raise ValueError("arrays of other shapes")
        places = (data["parents"], data["faces"], data["order"])
        if any(x.min(initial=0) < 0 or x.max(initial=0) >= count for x in places):
            raise ValueError("vertices that aren't there")
        if not np.array_equal(np.sort(data["order"]), np.arange(count)):
            raise ValueError("no order of the vertices")
        return data


@contextlib.contextmanager
def _damage_told(path: pathlib.Path) -> Iterator[None]:
    """What a library says of a damaged file, as `FormatError`."""
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
        raise FormatError(f"{path}: missing; the garment of {folder.name}/{template}.")
    return _codec(path.absolute(), path.stat().st_mtime_ns)


def write_offsets(
    folder: pathlib.Path,
    template: str,
    offsets: Float[np.ndarray, "frames vertices 3"],
    meta: dict[str, Any],
) -> None:
    """One garment of one action; it appears whole or not at all.

    Args:
        folder: The action's folder.
        template: Name of the garment; `write_garment` stored it.
        offsets: Cloth minus skinning [m].
        meta: Noted as attributes of the array.

    Raises:
        FormatError: An offset beyond the 3.2 m that can be stored: an explosion.
    """
    whole = np.round(offsets / QUANTUM)
    if not np.isfinite(whole).all() or np.abs(whole).max() > _LARGEST / QUANTUM:
        raise FormatError(
            f"{folder.name}/{template}: cloth is more than {_LARGEST} m from the body or not"
            " finite; simulate it again with more substeps."
        )
    left = _codec_of(folder, template).encode(whole.astype(np.int64))
    part = folder / f".{template}.part"
    shutil.rmtree(part, ignore_errors=True)
    store = ts.open(
        {
            "driver": "zarr3",
            "kvstore": {"driver": "file", "path": str(part)},
            "metadata": {
                "shape": list(left.shape),
                "data_type": "uint32",
                "chunk_grid": {
                    "name": "regular",
                    "configuration": {"chunk_shape": list(left.shape)},
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
                    "quantum": QUANTUM,
                    "frames": len(offsets),
                    "sha256": hashlib.sha256(left.tobytes()).hexdigest(),
                },
            },
        },
        create=True,
    ).result()
    store.write(left).result()
    final = folder / template
    shutil.rmtree(final, ignore_errors=True)
    os.replace(part, final)


def read_offsets(folder: pathlib.Path, template: str) -> Float[np.ndarray, "frames vertices 3"]:
    """Offsets [m] of one garment of one action.

    Raises:
        FormatError: Damaged.
    """
    path = folder / template
    codec, frames = _codec_of(folder, template), read_meta(folder, template).get("frames")
    with _damage_told(path):
        spec = {"driver": "zarr3", "kvstore": {"driver": "file", "path": str(path)}}
        store = ts.open(spec, read=True).result()
        # Before memory is asked for: a kilobyte may announce gigabytes of nothing.
        fits = store.shape == (3, len(codec.order), frames) and store.dtype == ts.uint32
        if not fits or math.prod(store.shape) > _MOST:
            raise ValueError("an array of another shape")
        left = np.ascontiguousarray(store.read().result())
    if hashlib.sha256(left.tobytes()).hexdigest() != read_meta(folder, template).get("sha256"):
        raise FormatError(
            f"{folder.name}/{template}: the checksum is wrong; delete that folder and build"
            " the dataset again, only this part will be simulated."
        )
    return codec.decode(left).astype(np.float32) * np.float32(QUANTUM)


def read_meta(folder: pathlib.Path, template: str) -> dict[str, Any]:
    """What was noted of one garment of one action.

    Raises:
        FormatError: Damaged.
    """
    path = folder / template / "zarr.json"
    with _damage_told(path):
        return _table(_table(json.loads(path.read_text()))["attributes"])


def is_stored(folder: pathlib.Path, template: str) -> bool:
    """Whether a garment of an action is there."""
    return (folder / template / "zarr.json").is_file()


def write_action(folder: pathlib.Path, motion: Motion, split: str) -> None:
    """The motion of an action and what split it is in.

    Raises:
        FormatError: Another motion lies there: its garments belong to that one.
    """
    folder.mkdir(parents=True, exist_ok=True)
    there = folder / "motion.npz"
    if there.is_file():
        before = load_motion(there)
        pairs = ((before.rotations, motion.rotations), (before.root, motion.root))
        same = all(a.shape == b.shape and np.allclose(a, b, atol=1e-4) for a, b in pairs)
        if not same or before.fps != motion.fps:
            raise FormatError(
                f"{folder}: its motion isn't the one that is simulated now, by other files or"
                " another version. Delete that folder, or build into another one."
            )
    else:
        save_motion(there, motion)
    note = folder / "action.json"
    if note.is_file() and _action_note(note)["split"] != split:
        raise FormatError(
            f"{folder}: stored as '{_action_note(note)['split']}', now '{split}'. A set whose"
            " splits changed has to be built anew: choose another folder."
        )
    with whole_file(note) as part:
        part.write_text(json.dumps({"name": motion.name, "split": split}))


def read_sequence(folder: str | pathlib.Path) -> Sequence:
    """An action with every garment that has been simulated for it.

    Raises:
        FormatError: The folder doesn't hold an action.
    """
    folder = pathlib.Path(folder)
    note = folder / "action.json"
    if not note.is_file():
        raise FormatError(f"{folder}: no action.json, not an action of a dataset.")
    info = _action_note(note)
    motion = load_motion(folder / "motion.npz")
    # What begins with a dot is being written, or was when its process was killed.
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
    with _damage_told(path):
        told = json.loads(path.read_text())
        return {"name": str(told["name"]), "split": str(told["split"])}


def log_build(root: str | pathlib.Path, line: dict[str, Any]) -> None:
    """Adds a line to the log of a build: what took how long."""
    append_line(pathlib.Path(root) / _LOG, line)


def read_log(root: str | pathlib.Path) -> list[dict[str, Any]]:
    """The log of a build; a line cut by a kill is left out."""
    return read_lines(pathlib.Path(root) / _LOG)


def _unfinished(path: pathlib.Path) -> bool:
    return any(part.startswith(".") for part in path.parts)


def dataset_digest(root: str | pathlib.Path) -> tuple[str, int]:
    """Checksum of all that a dataset is (times apart), and its bytes."""
    root = pathlib.Path(root)
    total, size = hashlib.sha256(), 0
    files = (p for p in root.rglob("*") if p.is_file() and p.name != _LOG)
    for path in sorted(p for p in files if not _unfinished(p.relative_to(root))):
        blob = path.read_bytes()
        size += len(blob)
        total.update(f"{path.relative_to(root)} {hashlib.sha256(blob).hexdigest()}\n".encode())
    return total.hexdigest(), size
