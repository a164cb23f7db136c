"""Packs what a CUDA machine without a network needs beside the tracked files.

Command: python experiments/cuda/pack.py [--out out/cuda]
Cost:    ten minutes; needs the motions (PHYSXNET_DATA) and the package registry.
Result:  out/cuda/mocap.npz, the motions of training and extra actions with their tables;
         out/cuda/clothes.pkl, the garments of all outfits as cut and the tables that training makes
         of them; and out/cuda/wheels/, the pure Python packages that such a machine doesn't have.
         Together 35 MB; git ignores all.
"""

import argparse
import csv
import lzma
import pathlib
import pickle
import subprocess
import sys
import tempfile
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console

from physxnet_jax.cli._configs import mocap_folder, read_config
from physxnet_jax.data import (
    Action,
    DatasetConfig,
    Outfit,
    left_out,
    load_action,
    make_wardrobe,
    read_protocol,
)
from physxnet_jax.files import atomic_write
from physxnet_jax.motion import save_motion
from physxnet_jax.training import TrainConfig
from physxnet_jax.training._garment_tables import prepare_garments

HERE = pathlib.Path(__file__).parent
WHEELS = ("tyro", "trimesh", "beartype", "docstring-parser", "typeguard")
SPLITS = ("train", "extra")
# Folders of the archive: actions, and what the protocol leaves out of their clips.
FOLDERS = ("actions", "left")


def pack_motions(folder: pathlib.Path, path: pathlib.Path) -> None:
    """Writes actions, at 30 frames a second, and their protocols to one npz archive."""
    path.parent.mkdir(parents=True, exist_ok=True)
    actions = [a for a in read_protocol(folder) if a.split in SPLITS]
    contents = {}
    with tempfile.TemporaryDirectory() as scratch:
        for name, chosen in zip(FOLDERS, (actions, left_out(folder, actions)), strict=True):
            place = pathlib.Path(scratch) / name
            place.mkdir()
            _write_actions(folder, chosen, place)
            for file in sorted(place.iterdir()):
                contents[f"{name}/{file.name}"] = np.frombuffer(file.read_bytes(), np.uint8)
    with atomic_write(path) as part, part.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **contents)


def _write_actions(folder: pathlib.Path, actions: list[Action], place: pathlib.Path) -> None:
    with (place / "ACTIONS.csv").open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["split", "action", "file", "start_s", "frames_at_30fps"])
        for action in actions:
            motion = load_action(folder, action)
            save_motion(place / f"{action.slug}.npz", motion)
            table.writerow(
                [action.split, action.name, f"{action.slug}.npz", 0.0, motion.num_frames]
            )


def unpack_motions(path: pathlib.Path, folder: pathlib.Path) -> None:
    """Writes the files of such an archive below a folder."""
    with np.load(path) as contents:
        for name in contents.files:
            target = folder / name
            if not target.resolve().is_relative_to(folder.resolve()):
                raise ValueError(f"{path}: {name} leads out of the folder.")
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(contents[name].tobytes())


def outfits() -> tuple[Outfit, ...]:
    """All outfits that are learned, in the order of the tables."""
    found = [
        read_config(str(HERE.parent / f"datasets.toml#{table}"), DatasetConfig).outfits
        for table in ("default", "variants")
    ]
    return tuple(dict.fromkeys(o for some in found for o in some))


def pack_clothes(path: pathlib.Path, outfits: tuple[Outfit, ...], config: TrainConfig) -> None:
    """Writes the garments of outfits, their wardrobe and its tables."""
    console = Console()
    garments: dict[Outfit, Any] = {}
    for k, outfit in enumerate(outfits):
        console.print(f"{k} of {len(outfits)}: {' and '.join(outfit.wear)}", highlight=False)
        garments[outfit] = outfit.garments()
    wardrobe = make_wardrobe(list(outfits), config.model.templates)
    console.print("tables")
    tables = prepare_garments(config.model, wardrobe, elastic=config.elastic_weight > 0)
    stored = {"garments": garments, "wardrobe": wardrobe, "tables": tables}
    with atomic_write(path) as part, lzma.open(part, "wb") as file:
        _Pickler(file, protocol=5).dump(stored)


class _Pickler(pickle.Pickler):
    """Writes arrays so that another version of jax reads them."""

    def reducer_override(self, obj: Any) -> Any:
        if isinstance(obj, jax.Array):
            return jnp.asarray, (np.asarray(obj),)
        return NotImplemented


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("out/cuda"))
    out = parser.parse_args().out
    console = Console()
    pack_motions(mocap_folder(None), out / "mocap.npz")
    download = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps"]
    download += ["--only-binary=:all:", "--python-version", "3.12", "--dest", str(out / "wheels")]
    subprocess.run([*download, *WHEELS], check=True)
    config = read_config(str(HERE.parent / "training.toml#base-cuda"), TrainConfig)
    pack_clothes(out / "clothes.pkl", outfits(), config)
    for path in sorted(p for p in out.rglob("*") if p.is_file()):
        console.print(f"{path.stat().st_size / 1e6:6.2f} MB  {path}", highlight=False)
    return 0


if __name__ == "__main__":
    sys.exit(main())
