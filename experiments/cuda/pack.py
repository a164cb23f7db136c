"""Packs what a CUDA machine without a network needs beside the tracked files.

Command: python experiments/cuda/pack.py [--out out/cuda]
Cost:    half a minute; needs the motions (PHYSXNET_DATA) and the package registry.
Result:  out/cuda/mocap.npz, the motion files of the training actions with their tables, and
         out/cuda/wheels/, the pure Python packages that such a machine doesn't have. Together
         under 25 MB; git ignores both.
"""

import argparse
import pathlib
import subprocess
import sys

import numpy as np
from rich.console import Console

from physxnet_jax.cli._configs import mocap_folder
from physxnet_jax.data import read_protocol

WHEELS = ("tyro", "trimesh", "beartype", "docstring-parser", "typeguard")


def motion_files(folder: pathlib.Path, split: str = "train") -> list[pathlib.Path]:
    """Files of a split's actions, the skeletons that they refer to, and the tables."""
    files = {folder / a.file for a in read_protocol(folder) if a.split == split}
    skeletons = {p.with_name(f"{p.stem.split('_')[0]}.asf") for p in files if p.suffix == ".amc"}
    tables = {folder / "ACTIONS.csv", folder / "CLIPS.csv"}
    return sorted(p for p in files | skeletons | tables if p.is_file())


def pack_motions(folder: pathlib.Path, path: pathlib.Path) -> None:
    """Writes motion files, byte for byte, to one npz archive."""
    path.parent.mkdir(parents=True, exist_ok=True)
    contents = {
        p.relative_to(folder).as_posix(): np.frombuffer(p.read_bytes(), np.uint8)
        for p in motion_files(folder)
    }
    np.savez_compressed(path, allow_pickle=False, **contents)


def unpack_motions(path: pathlib.Path, folder: pathlib.Path) -> None:
    """Writes the files of such an archive below a folder."""
    with np.load(path) as contents:
        for name in contents.files:
            target = folder / name
            if not target.resolve().is_relative_to(folder.resolve()):
                raise ValueError(f"{path}: {name} leads out of the folder.")
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(contents[name].tobytes())


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("out/cuda"))
    out = parser.parse_args().out
    console = Console()
    pack_motions(mocap_folder(None), out / "mocap.npz")
    download = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps"]
    download += ["--only-binary=:all:", "--python-version", "3.12", "--dest", str(out / "wheels")]
    subprocess.run([*download, *WHEELS], check=True)
    for path in sorted(p for p in out.rglob("*") if p.is_file()):
        console.print(f"{path.stat().st_size / 1e6:6.2f} MB  {path}", highlight=False)
    return 0


if __name__ == "__main__":
    sys.exit(main())
