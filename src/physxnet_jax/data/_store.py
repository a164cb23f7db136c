"""Simulated actions in a store: zarr arrays through tensorstore, one folder per action.

A store is a folder or any URL that tensorstore takes (``s3://``, ``gs://``, ``file:///a/|ocdbt:``).
``dataset.json`` describes the dataset, ``garments/`` holds each garment once, and every
action's folder holds the motion and one array per garment. The body follows from the motion.
"""

import contextlib
import dataclasses
import functools
import hashlib
import io
import json
import math
import pathlib
from collections.abc import Iterator
from typing import Any

import numpy as np
import tensorstore as ts
from jaxtyping import Float, Int

from ..errors import FormatError
from ..files import read_arrays
from ..garment import Garment
from ..motion import Motion, make_motion
from ._codec import Codec, make_codec
from ._files import join, last_name, list_files, open_array, read_file, remove_file, write_file
from ._outfit import Clothing, Outfit, Worn, garment_of, read_outfit

Where = str | pathlib.Path
"""A path or a URL."""

# Offsets are rounded to tenths of a millimetre: the error is at most 0.05 mm.
QUANTIZATION_STEP = 1e-4
_MAX_OFFSET = 3.2
# Largest number of coordinates that are read for one garment in one action.
_MAX_COORDINATES = 3e8
_NOTE, _ACTION, _ARRAY, _MOTION = "dataset.json", "action.json", "zarr.json", "motion.npz"
# Timings differ between runs: they aren't part of the dataset's digest.
_TIMES, _OLD_LOG = "times", "build_log.jsonl"
# Derived from the rest, so that it isn't part of the digest either.
_INDEX = "index.json"
_INDEXED = ("folder", "name", "action", "split", "frames", "fps", "content", "outfit")


@dataclasses.dataclass(frozen=True)
class Sequence:
    """One simulated action.

    Attributes:
        name: Name of the action; of an action in outfits followed by the outfit's number.
        split: ``train``, ``test`` or ``extra``.
        motion: The body's motion, named after the action.
        offsets: For each template, cloth minus its linear blend skinning [m], shape
            [frames, vertices, 3].
        meta: Further metadata of each template: engine, settings, diagnostics.
        outfit: What is worn; None for the templates on the default shape.
    """

    name: str
    split: str
    motion: Motion
    offsets: dict[str, Float[np.ndarray, "frames vertices 3"]]
    meta: dict[str, Any]
    outfit: Outfit | None = None

    def clothing(self, name: str) -> Clothing:
        """What is worn of a template."""
        if self.outfit is None:
            return name  # pyright: ignore[reportReturnType]
        return Worn(outfit=self.outfit, template=name)

    def garment(self, name: str) -> Garment:
        """The garment of a template."""
        return garment_of(self.clothing(name))


def open_dataset(root: Where, note: dict[str, Any]) -> None:
    """Creates a dataset, or checks that the existing one has the same configuration.

    Raises:
        FormatError: The folder holds another dataset.
    """
    text = json.dumps(note, indent=1, sort_keys=True)
    if read_file(root, _NOTE) is None:
        write_file(root, _NOTE, text.encode())
    elif read_note(root) != json.loads(text):
        raise FormatError(
            f"{root}: the folder holds a dataset of another configuration. Choose another"
            " folder or delete it."
        )


def read_note(root: Where) -> dict[str, Any]:
    """The settings that a dataset stores about itself.

    Raises:
        FormatError: The file is missing or damaged.
    """
    found = read_file(root, _NOTE)
    if found is None:
        raise FormatError(f"{root}: no {_NOTE}, not a dataset; build one first.")
    with _report_damage(join(root, _NOTE)):
        return _as_dict(json.loads(found))


def _as_dict(parsed: object) -> dict[str, Any]:
    if not isinstance(parsed, dict):
        raise TypeError("not a table")
    return parsed


def write_garment(
    root: Where,
    name: str,
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
) -> None:
    """Stores a garment at rest [m] and the codec of its offsets, once.

    Raises:
        FormatError: Another garment is stored under that name, or it has too many vertices.
    """
    folder, file = join(root, "garments"), f"{name}.npz"
    path, found = join(folder, file), read_file(folder, file)
    if found is not None:
        stored = _archive(path, found)
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
    content = io.BytesIO()
    np.savez_compressed(
        content,
        vertices=np.asarray(vertices, np.float32),
        faces=np.asarray(faces, np.int32),
        order=codec.order.astype(np.int16),
        parents=codec.parents.astype(np.int16),
        weights=codec.weights.astype(np.int16),
    )
    write_file(folder, file, content.getvalue())


@functools.lru_cache(maxsize=8)
def _codec(path: str, content: bytes) -> Codec:
    data = _archive(path, content)
    return Codec(*(data[k].astype(np.int64) for k in ("order", "parents", "weights")))


def _archive(path: str, content: bytes) -> dict[str, np.ndarray]:
    names = ("vertices", "faces", "order", "parents", "weights")
    with _report_damage(path):
        data = read_arrays(content, names)
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
def _report_damage(path: Where) -> Iterator[None]:
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


def _codec_of(folder: Where, template: str) -> Codec:
    garments = join(str(folder).rstrip("/").removesuffix(last_name(folder)), "garments")
    found = read_file(garments, f"{template}.npz")
    path = join(garments, f"{template}.npz")
    if found is None:
        raise FormatError(f"{path}: missing; {last_name(folder)}/{template} needs this garment.")
    return _codec(path, found)


def write_offsets(
    folder: Where,
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
            f"{last_name(folder)}/{template}: cloth is more than {_MAX_OFFSET} m from the body or"
            " not finite; simulate it again with more substeps."
        )
    residuals = _codec_of(folder, template).encode(integers.astype(np.int64))
    attributes = {
        **meta,
        "unit": "m",
        "quantum": QUANTIZATION_STEP,
        "frames": len(offsets),
        "sha256": hashlib.sha256(residuals.tobytes()).hexdigest(),
    }
    files = _array_files(residuals, attributes)
    # The array exists once its description does.
    for name in sorted(files, key=lambda n: n == _ARRAY):
        write_file(join(folder, template), name, files[name])


def _array_files(values: np.ndarray, attributes: dict[str, Any]) -> dict[str, bytes]:
    """The files of a zarr array, by name."""
    context = ts.Context()
    store = ts.open(
        {
            "driver": "zarr3",
            "kvstore": "memory://",
            "metadata": {
                "shape": list(values.shape),
                "data_type": "uint32",
                "chunk_grid": {
                    "name": "regular",
                    "configuration": {"chunk_shape": list(values.shape)},
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
                "attributes": attributes,
            },
        },
        create=True,
        context=context,
    ).result()
    store.write(values).result()
    memory = ts.KvStore.open("memory://", context=context).result()
    return {key.decode(): bytes(memory[key]) for key in memory.list().result()}


def read_offsets(folder: Where, template: str) -> Float[np.ndarray, "frames vertices 3"]:
    """Offsets [m] of one garment in one action.

    Raises:
        FormatError: The array is damaged.
    """
    path = join(folder, template)
    codec, meta = _codec_of(folder, template), read_meta(folder, template)
    frames = meta.get("frames")
    with _report_damage(path):
        store = open_array(path).result()
        # Checked before allocation: a kilobyte on disk may declare gigabytes of zeros.
        fits = store.shape == (3, len(codec.order), frames) and store.dtype == ts.uint32
        if not fits or math.prod(store.shape) > _MAX_COORDINATES:
            raise ValueError("unexpected shape or data type")
        residuals = np.ascontiguousarray(store.read().result())
    if hashlib.sha256(residuals.tobytes()).hexdigest() != meta.get("sha256"):
        raise FormatError(
            f"{last_name(folder)}/{template}: the checksum is wrong; delete that folder and build"
            " the dataset again, only this part will be simulated."
        )
    return codec.decode(residuals).astype(np.float32) * np.float32(QUANTIZATION_STEP)


def read_meta(folder: Where, template: str) -> dict[str, Any]:
    """Metadata of one garment in one action.

    Raises:
        FormatError: The metadata is damaged.
    """
    path = join(folder, template)
    with _report_damage(join(path, _ARRAY)):
        return _as_dict(_as_dict(json.loads(_existing(path, _ARRAY)))["attributes"])


def _existing(where: Where, name: str) -> bytes:
    found = read_file(where, name)
    if found is None:
        raise FileNotFoundError(join(where, name))
    return found


def is_stored(folder: Where, template: str) -> bool:
    """Whether a garment of an action is stored."""
    return read_file(join(folder, template), _ARRAY) is not None


def write_action(
    folder: Where, motion: Motion, split: str, outfit: Outfit | None = None, number: int = 0
) -> None:
    """Writes the motion of an action, its split, and the outfit with its number.

    Raises:
        FormatError: The folder holds another motion, which its garments belong to, or another
            split.
    """
    if read_file(folder, _MOTION) is not None:
        stored = _read_motion(folder)
        pairs = ((stored.rotations, motion.rotations), (stored.root, motion.root))
        same = all(a.shape == b.shape and np.allclose(a, b, atol=1e-4) for a, b in pairs)
        if not same or stored.fps != motion.fps:
            raise FormatError(
                f"{folder}: its motion isn't the one to simulate: it comes from other files or"
                " another version. Delete that folder, or build into another one."
            )
    else:
        content = io.BytesIO()
        np.savez_compressed(
            content,
            rotations=np.asarray(motion.rotations),
            root=np.asarray(motion.root),
            fps=np.asarray(motion.fps),
        )
        write_file(folder, _MOTION, content.getvalue())
    if read_file(folder, _ACTION) is not None and _action_note(folder)["split"] != split:
        raise FormatError(
            f"{folder}: stored as '{_action_note(folder)['split']}', now '{split}'. A"
            " dataset whose splits changed must be rebuilt: choose another folder."
        )
    note: dict[str, Any] = {"name": motion.name, "split": split}
    if outfit is not None:
        note |= {"number": number, "outfit": dataclasses.asdict(outfit)}
    write_file(folder, _ACTION, json.dumps(note).encode())


def _read_motion(folder: Where, name: str = "") -> Motion:
    with _report_damage(join(folder, _MOTION)):
        data = read_arrays(_existing(folder, _MOTION), ("rotations", "root", "fps"))
        rate = float(data["fps"].reshape(()))
        return make_motion(data["rotations"], data["root"], rate, name=name)


def read_sequence(folder: Where) -> Sequence:
    """Reads an action with every garment that has been simulated for it.

    Raises:
        FormatError: The folder doesn't hold an action.
    """
    described = read_description(folder)
    offsets = {template_of(x): read_offsets(folder, x) for x in _arrays(folder)}
    return dataclasses.replace(described, offsets=offsets)


def template_of(array: str) -> str:
    """The template of an array: its name without the outfit's number."""
    return array.partition("-")[0]


def _arrays(folder: Where) -> list[str]:
    """Names of an action's arrays."""
    # The description of an array is written last: what lacks it is in progress or interrupted.
    parts = [name.split("/") for name in list_files(folder)]
    return [p[0] for p in parts if p[1:] == [_ARRAY]]


def read_description(folder: Where) -> Sequence:
    """An action with each garment's metadata; its cloth isn't read."""
    info = _action_note(folder)
    motion = _read_motion(folder, info["name"])
    meta = {template_of(x): read_meta(folder, x) for x in _arrays(folder)}
    return Sequence(info["sequence"], info["split"], motion, {}, meta, info["outfit"])


def list_sequences(root: Where, split: str | None = None) -> list[str]:
    """Folders of a dataset's actions, sorted, optionally of one split."""
    parts = [name.split("/") for name in list_files(root)]
    folders = [join(root, p[0]) for p in parts if p[1:] == [_ACTION]]
    return [f for f in folders if split is None or _action_note(f)["split"] == split]


def _action_note(folder: Where) -> dict[str, Any]:
    found = read_file(folder, _ACTION)
    if found is None:
        raise FormatError(f"{folder}: no {_ACTION}, not an action of a dataset.")
    with _report_damage(join(folder, _ACTION)):
        parsed = json.loads(found)
        name, outfit = str(parsed["name"]), read_outfit(parsed.get("outfit"))
        full = name if outfit is None else sequence_name(name, int(parsed["number"]))
        return {"name": name, "sequence": full, "split": str(parsed["split"]), "outfit": outfit}


def sequence_name(action: str, number: int) -> str:
    """The name of an action in the outfit of a number."""
    return f"{action} #{number:02d}"


def write_index(root: Where, lines: list[dict[str, Any]]) -> None:
    """Stores what `read_index` returns."""
    write_file(root, _INDEX, json.dumps(lines).encode())


def read_index(root: Where) -> list[dict[str, Any]] | None:
    """A line for each action, or None if none is stored or actions were added since."""
    found = read_file(root, _INDEX)
    if found is None:
        return None
    with _report_damage(join(root, _INDEX)):
        return [{k: _as_dict(line)[k] for k in _INDEXED} for line in json.loads(found)]


def remove_index(root: Where) -> None:
    """Removes the index, before what it lists changes."""
    remove_file(root, _INDEX)


def write_times(root: Where, action: str, template: str, line: dict[str, Any]) -> None:
    """Stores what a garment of an action took: a file each, for many machines may write."""
    write_file(join(root, _TIMES), f"{action}-{template}.json", json.dumps(line).encode())


def read_times(root: Where) -> list[dict[str, Any]]:
    """What each garment of each action took; damaged files are skipped."""
    out = []
    for name in list_files(join(root, _TIMES)):
        with contextlib.suppress(ValueError, RecursionError):
            out.append(json.loads(read_file(join(root, _TIMES), name) or b""))
    return [line for line in out if isinstance(line, dict)]


def dataset_digest(root: Where) -> tuple[str, int]:
    """Checksum of a dataset's files (times and index excluded), and their size in bytes."""
    total, size = hashlib.sha256(), 0
    for name in list_files(root):
        if name in (_OLD_LOG, _INDEX) or name.startswith(f"{_TIMES}/"):
            continue
        content = read_file(root, name) or b""
        size += len(content)
        total.update(f"{name} {hashlib.sha256(content).hexdigest()}\n".encode())
    return total.hexdigest(), size
