"""Simulated actions on disk: zarr arrays through tensorstore, one folder an action."""

import dataclasses
import json
import os
import pathlib
import shutil
from typing import Any

import numpy as np
import tensorstore as ts
from jaxtyping import Float

from ..errors import FormatError
from ..motion import Motion, load_motion, save_motion

# Offsets are stored as whole tenths of a millimetre: the error is at most 0.05 mm.
QUANTUM = 1e-4


@dataclasses.dataclass(frozen=True)
class Sequence:
    """One simulated action.

    Attributes:
        name: Name of the action.
        split: ``train``, ``test`` or ``extra``.
        motion: The body's motion.
        offsets: For each template, cloth minus its linear blend skinning [m], shape
            [frames, vertices, 3].
        meta: What else was noted: engine, settings, diagnostics.
    """

    name: str
    split: str
    motion: Motion
    offsets: dict[str, Float[np.ndarray, "frames vertices 3"]]
    meta: dict[str, Any]


def write_offsets(
    folder: pathlib.Path,
    template: str,
    offsets: Float[np.ndarray, "frames vertices 3"],
    meta: dict[str, Any],
) -> None:
    """One garment of one action; it appears whole or not at all.

    Args:
        folder: The action's folder.
        template: Name of the garment.
        offsets: Cloth minus skinning [m].
        meta: Noted beside the array.

    Raises:
        FormatError: An offset beyond the 3.2 m that can be stored: an explosion.
    """
    whole = np.round(offsets / QUANTUM)
    if not np.isfinite(whole).all() or np.abs(whole).max() > 32000:
        raise FormatError(
            f"{folder.name}/{template}: cloth is more than 3.2 m from the body or not"
            " finite; simulate it again with more substeps."
        )
    part = folder / f".{template}.part"
    shutil.rmtree(part, ignore_errors=True)
    store = ts.open(
        {
            "driver": "zarr3",
            "kvstore": {"driver": "file", "path": str(part / "offsets")},
            "metadata": {
                "shape": list(whole.shape),
                "data_type": "int16",
                "chunk_grid": {
                    "name": "regular",
                    "configuration": {"chunk_shape": [min(64, whole.shape[0]), *whole.shape[1:]]},
                },
                "codecs": [
                    {"name": "bytes", "configuration": {"endian": "little"}},
                    {"name": "zstd", "configuration": {"level": 12}},
                ],
                "attributes": {"unit": "m", "quantum": QUANTUM},
            },
        },
        create=True,
    ).result()
    store.write(whole.astype(np.int16)).result()
    (part / "meta.json").write_text(json.dumps(meta, indent=1, sort_keys=True))
    final = folder / template
    shutil.rmtree(final, ignore_errors=True)
    os.replace(part, final)


def read_offsets(folder: pathlib.Path, template: str) -> Float[np.ndarray, "frames vertices 3"]:
    """Offsets [m] of one garment of one action."""
    store = ts.open(
        {
            "driver": "zarr3",
            "kvstore": {"driver": "file", "path": str(folder / template / "offsets")},
        },
        read=True,
    ).result()
    return np.asarray(store.read().result(), dtype=np.float32) * np.float32(QUANTUM)


def write_action(folder: pathlib.Path, motion: Motion, split: str) -> None:
    """The motion of an action and what split it is in."""
    folder.mkdir(parents=True, exist_ok=True)
    save_motion(folder / "motion.npz", motion)
    (folder / "action.json").write_text(json.dumps({"name": motion.name, "split": split}))


def read_sequence(folder: str | pathlib.Path) -> Sequence:
    """An action with every garment that has been simulated for it.

    Raises:
        FormatError: The folder doesn't hold an action.
    """
    folder = pathlib.Path(folder)
    note = folder / "action.json"
    if not note.is_file():
        raise FormatError(f"{folder}: no action.json, not an action of a dataset.")
    info = json.loads(note.read_text())
    motion = load_motion(folder / "motion.npz")
    found = sorted(p.parent.name for p in folder.glob("*/meta.json"))
    return Sequence(
        info["name"],
        info["split"],
        Motion(motion.rotations, motion.root, motion.fps, info["name"]),
        {name: read_offsets(folder, name) for name in found},
        {name: json.loads((folder / name / "meta.json").read_text()) for name in found},
    )


def list_sequences(root: str | pathlib.Path, split: str | None = None) -> list[pathlib.Path]:
    """Folders of a dataset's actions, sorted, optionally of one split."""
    out = []
    for note in sorted(pathlib.Path(root).glob("*/action.json")):
        if split is None or json.loads(note.read_text())["split"] == split:
            out.append(note.parent)
    return out
