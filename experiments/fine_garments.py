"""Garment files of many vertices and layers: seconds to inspect and to bind, milliseconds to dress.

Command: python experiments/fine_garments.py, with the folder of garments in PHYSXNET_DATA
Cost:    five minutes on two cores.
Result:  experiments/results/fine_garments.json and .md: for files whose triangles are cut into four
         again and again, alone and in layers a few millimetres apart: seconds to inspect a mesh, to
         read it and place it on the body, and to bind it, compilation included, and milliseconds a
         frame by the network (median of blocks after the first).
"""

import argparse
import os
import pathlib
import tempfile
import time

import numpy as np
import trimesh
from rich.console import Console

from physxnet_jax import dress
from physxnet_jax.dressing import inspect_garment
from physxnet_jax.evaluation import machine
from physxnet_jax.files import atomic_write, write_json
from physxnet_jax.io import read_mesh, write_obj

RESULTS = pathlib.Path(__file__).parent / "results"
DATA = pathlib.Path(os.environ.get("PHYSXNET_DATA", pathlib.Path(__file__).parents[2] / "shared"))
# File, how often its triangles are cut, layers, and their distance over the mesh's height.
CASES: tuple[tuple[str, int, int, float], ...] = (
    ("longsleeve.obj", 0, 1, 0.0),
    ("longsleeve.obj", 1, 5, 0.003),
    ("longsleeve.obj", 2, 2, 0.005),
    ("longsleeve.obj", 3, 1, 0.0),
    ("F_Dress_01.obj", 3, 1, 0.0),
)
FRAMES = 60


def fine(path: pathlib.Path, cuts: int, layers: int, apart: float) -> tuple[np.ndarray, np.ndarray]:
    """Vertices in the file's unit, and triangles."""
    raw = read_mesh(path)
    mesh = trimesh.Trimesh(raw.vertices, raw.faces, process=False)
    for _ in range(cuts):
        mesh = mesh.subdivide()
    x, faces, n = np.asarray(mesh.vertices), np.asarray(mesh.faces), len(mesh.vertices)
    steps = apart * float(np.ptp(x[:, 1])) * np.arange(layers)
    every = [x + s * np.asarray(mesh.vertex_normals) for s in steps]
    return np.concatenate(every), np.concatenate([faces + k * n for k in range(layers)])


def measure(path: pathlib.Path) -> dict[str, float]:
    """Times of one file."""
    begun = time.perf_counter()
    inspect_garment(path)
    seconds = time.perf_counter() - begun
    clip = dress("walk", [path], method="network", frames=FRAMES, include_body=False)
    stages = {s.name: s for s in clip.stages}
    return {
        "vertices": clip.garments[0].positions.shape[1],
        "inspect_s": seconds,
        "place_s": 1e-3 * stages["garments"].cold_ms,
        "bind_s": 1e-3 * stages["binding"].cold_ms,
        "network_ms": float(stages["network"].warm_ms or np.nan),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--out", type=pathlib.Path, default=RESULTS / "fine_garments.json")
    options = parser.parse_args()
    console = Console()
    rows: list[dict[str, float | str]] = []
    with tempfile.TemporaryDirectory() as folder:
        for name, cuts, layers, apart in CASES:
            path = pathlib.Path(folder) / name
            write_obj(path, *fine(DATA / "garments" / name, cuts, layers, apart))
            row = {"file": name, "cuts": cuts, "layers": layers, **measure(path)}
            rows.append(row)
            console.print(row)
    write_json(options.out, {"machine": machine(), "rows": rows})
    lines = [
        "| file | layers | vertices | inspect, s | read, place, s | bind, s | network, ms |",
        "|---" * 7 + "|",
    ]
    for r in rows:
        times = (f"{r[k]:.1f}" for k in ("inspect_s", "place_s", "bind_s", "network_ms"))
        cells = [str(r["file"]), str(r["layers"]), f"{r['vertices']:,}", *times]
        lines.append(f"| {' | '.join(cells)} |")
    with atomic_write(options.out.with_suffix(".md")) as file:
        file.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
