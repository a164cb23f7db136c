"""A clip as Blender shows it, from every format it reads, against what was written.

Command: PHYSXNET_BLENDER=PYTHON-WITH-BPY python experiments/import_in_blender.py
         --frames 5, --out experiments/results/blender_import.md
Cost:    about half a minute on two cores.
Result:  blender_import.md: for USD, glTF, PC2, MDD, and Alembic that Blender made of the USD,
         the largest distance of a vertex in any frame from where it should be, Blender's Z
         being up. Scenes run at 30 frames a second.
"""

import argparse
import os
import pathlib
import subprocess
import tempfile

import numpy as np

from physxnet_jax.dressing import dress
from physxnet_jax.files import atomic_write
from physxnet_jax.io import AnimatedMesh, write_clip

HERE = pathlib.Path(__file__).parent
KINDS = ("usdc", "glb", "pc2", "mdd")
TOLD = {kind: f".{kind}" for kind in KINDS} | {"abc": ".usdc, exported from Blender as .abc"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=5)
    parser.add_argument("--out", default=str(HERE / "results" / "blender_import.md"))
    words = parser.parse_args()
    blender = os.environ.get("PHYSXNET_BLENDER")
    if not blender:
        parser.error("no Blender: set PHYSXNET_BLENDER to a Python that has bpy.")
    clip = dress("walk", ["bottom"], method="lbs", frames=words.frames, include_body=False)
    # Without seams, so that glTF keeps the order of vertices.
    mesh = clip.meshes[0]
    meshes = [AnimatedMesh(mesh.name, mesh.positions, mesh.faces)]
    with tempfile.TemporaryDirectory() as folder:
        for kind in KINDS:
            write_clip(pathlib.Path(folder) / f"clip.{kind}", meshes, 30.0)
        answer = str(pathlib.Path(folder) / "seen.npz")
        script = HERE / "peers" / "blender_import.py"
        subprocess.run(
            [blender, str(script), folder, answer, mesh.name, str(words.frames)], check=True
        )
        with np.load(answer) as data:
            seen = {k: data[k] for k in data.files}
    lines = ["| format | largest distance, m | vertices |", "|---|---|---|"]
    for kind, told in TOLD.items():
        gaps = []
        for k in range(words.frames):
            x, y, z = mesh.positions[k].T
            gaps.append(np.abs(seen[f"{kind}_{k}"] - np.stack([x, -z, y], axis=1)).max())
        lines.append(f"| {told} | {max(gaps):.1e} | {len(mesh.positions[0]):,} |")
    with atomic_write(words.out) as part:
        part.write_text("\n".join(lines) + "\n")
    print("\n".join(lines))  # noqa: T201


if __name__ == "__main__":
    main()
