"""`physxnet dataset`: builds or checks a dataset."""

import dataclasses
import time

import numpy as np
from rich.console import Console
from rich.table import Table

from ..data import (
    DatasetConfig,
    Sequence,
    build_dataset,
    dataset_digest,
    expected_frames,
    list_sequences,
    read_sequence,
    read_times,
    write_protocol,
)
from ..errors import FormatError
from ..evaluation import Finding, check_sequence, skinning
from ..files import atomic_write, check_writable
from ..garment import TEMPLATES, Template
from ..io import AnimatedMesh
from ..viewer import render_frame
from ._configs import mocap_folder, read_config
from ._experiment_commands import Dataset
from ._options import ray_address
from ._progress import print_json, progress_bars

_TILE = (220, 260)


def dataset(command: Dataset, console: Console) -> int:
    """Builds or checks a dataset; returns 1 if a check finds a problem."""
    if command.what == "template":
        return _template(command, console)
    return _build(command, console) if command.what == "build" else _check(command, console)


def _template(command: Dataset, console: Console) -> int:
    """Writes a table of the motions in a folder."""
    with progress_bars(console) as progress:
        path, unread = write_protocol(command.target, progress)
    for line in unread:
        console.print(f"left out: {line}", highlight=False, markup=False)
    console.print(
        f"wrote {path}: check splits, starts and lengths, then"
        f" physxnet dataset build CONFIG --mocap {command.target} --out FOLDER",
        highlight=False,
    )
    if command.terminal.json:
        print_json({"files": [path], "left_out": unread})
    return 0


def _build(command: Dataset, console: Console) -> int:
    if command.out is None:
        raise FormatError("dataset build needs --out, the dataset's folder.")
    config = read_config(command.target, DatasetConfig)
    shard = _shard(command.shard)
    began = time.perf_counter()
    with progress_bars(console) as progress:
        done = build_dataset(
            config,
            command.out,
            mocap_folder(command.mocap),
            shard=shard,
            only=command.only,
            report=lambda text, k, n: progress("garments", k, n),
            ray=ray_address(command.ray),
        )
    digest, size = dataset_digest(command.out)
    spent = sum(line["seconds"] for line in read_times(command.out))
    console.print(
        f"{done} garments simulated in {time.perf_counter() - began:.0f} s ({spent:.0f} s for the"
        f" whole dataset); {size / 1e6:.1f} MB, sha256 {digest}",
        highlight=False,
    )
    if command.terminal.json:
        print_json({"sha256": digest, "bytes": size, "simulated": done, "seconds": spent})
    return 0


def _shard(text: str) -> tuple[int, int]:
    try:
        i, n = (int(x) for x in text.split("/"))
    except ValueError:
        i, n = 0, 0
    if not 0 <= i < n:
        raise FormatError(f"--shard {text}: expected i/n with 0 <= i < n, for example 0/4.")
    return i, n


def _check(command: Dataset, console: Console) -> int:
    if command.contact_sheet is not None:
        check_writable(command.contact_sheet)
    root = command.target
    folders = list_sequences(root)
    if not folders:
        raise FormatError(f"{root}: no actions found.")
    folder = mocap_folder(command.mocap)
    counts = expected_frames(root, folder) if folder.is_dir() else {}
    found: list[Finding] = []
    pictures = []
    with progress_bars(console) as progress:
        for k, path in enumerate(folders):
            progress("actions", k, len(folders))
            sequence = read_sequence(path)
            found += check_sequence(sequence, counts.get(sequence.name))
            if command.contact_sheet is not None:
                pictures.append(_picture(sequence))
    digest, size = dataset_digest(root)
    bad = [f for f in found if not f.holds]
    table = Table(title=f"{len(bad)} of {len(found)} findings are out of bounds")
    for column in ("action, garment", "quantity", "bound", "measured"):
        table.add_column(column)
    for f in bad:
        table.add_row(f.case, f.quantity, f"{f.bound:g}", f"{f.measured:.3g}")
    console.print(table)
    console.print(f"{len(folders)} actions, {size / 1e6:.1f} MB, sha256 {digest}", highlight=False)
    if command.terminal.json:
        print_json(
            {"sha256": digest, "bytes": size, "rows": [dataclasses.asdict(f) for f in found]}
        )
    if command.contact_sheet is not None:
        import imageio.v3 as iio

        with atomic_write(command.contact_sheet) as part:
            iio.imwrite(part, contact_sheet(pictures), extension=".png")
        console.print(f"wrote {command.contact_sheet}", highlight=False)
    return 1 if bad else 0


def _picture(sequence: Sequence) -> np.ndarray:
    """An action's garments side by side in its middle frame."""
    middle = sequence.motion.num_frames // 2
    tiles = []
    names: list[Template] = [t for t in TEMPLATES if t in sequence.offsets]
    for name in names:
        skinned = skinning()(sequence.motion, sequence.clothing(name)).positions
        cloth = skinned + sequence.offsets[name]
        faces = np.asarray(sequence.garment(name).mesh.faces)
        mesh = AnimatedMesh(name, cloth[middle : middle + 1], faces)
        tiles.append(render_frame([mesh], 0, size=_TILE))
    return np.concatenate(tiles, axis=1)


def contact_sheet(pictures: list[np.ndarray], columns: int = 3) -> np.ndarray:
    """Arranges images of equal height in rows; the rest is white."""
    width = max(p.shape[1] for p in pictures)
    rows = []
    for k in range(0, len(pictures), columns):
        row = [_padded(p, width) for p in pictures[k : k + columns]]
        row += [np.full_like(row[0], 255)] * (columns - len(row))
        rows.append(np.concatenate(row, axis=1))
    return np.concatenate(rows, axis=0)


def _padded(picture: np.ndarray, width: int) -> np.ndarray:
    more = width - picture.shape[1]
    return np.pad(picture, ((0, 0), (0, more), (0, 0)), constant_values=255)
