"""A character that nobody made for this program, in clothes.

Command: apt-get install assimp-utils assimp-testmodels
         python experiments/foreign_character.py /usr/share/assimp/models/X/BCN_Epileptic.X
Cost:    two minutes.
Result:  experiments/results/foreign_character.md, shown in docs/own-body.md, and its picture.
         A man of 2,633 vertices in three meshes, with bones and names of his maker's own,
         who jumps about for three seconds (a test model of the assimp library, BSD licence).
"""

import argparse
import pathlib
import subprocess
import tempfile
import time

import imageio.v3 as iio
import numpy as np

from physxnet_jax.dressing import Inference, dress, load_character
from physxnet_jax.files import atomic_write
from physxnet_jax.viewer import render_frame

RESULT = pathlib.Path(__file__).parent / "results/foreign_character.md"
PICTURE = pathlib.Path(__file__).parents[1] / "docs/foreign-character.png"
OUTFITS = (("top", "bottom"), ("dress",))
# Standing, bent sideways, in the air.
MOMENTS = (0, 20, 40)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file", type=pathlib.Path, help="glTF, or what assimp converts to it")
    file: pathlib.Path = parser.parse_args().file
    with tempfile.TemporaryDirectory() as folder:
        if file.suffix not in (".glb", ".gltf"):
            converted = pathlib.Path(folder) / "character.glb"
            subprocess.run(["assimp", "export", file, converted, "-fglb2"], check=True)
            file = converted
        began = time.perf_counter()
        person = load_character(file)
        spent = time.perf_counter() - began
    lines = [
        f"Laid on in {spent:.0f} s, {1e3 * person.apart:.0f} mm apart by shape and pose;"
        f" {person.mesh.positions.shape[1]:,} vertices, {len(person.mesh.positions)} frames.",
        "",
        "| garment | inside, as predicted, % | inside, moved out, % | moved at most, mm |",
        "|---|---|---|---|",
    ]
    pictures = []
    for outfit in OUTFITS:
        raw = dress(person, outfit, method="network", inference=Inference(collisions=False))
        clip = dress(person, outfit, method="network")
        for a, b in zip(raw.garments, clip.garments, strict=True):
            moved = np.linalg.norm(a.positions - b.positions, axis=2).max()
            lines.append(
                f"| {b.name} | {100 * raw.inside[b.name]:.2f} | {100 * clip.inside[b.name]:.2f}"
                f" | {1e3 * moved:.0f} |"
            )
        pictures += [render_frame(clip.meshes, k, size=(300, 400)) for k in MOMENTS]
    with atomic_write(RESULT) as part:
        part.write_text("\n".join(lines) + "\n")
    print("\n".join(lines))  # noqa: T201
    with atomic_write(PICTURE) as part:
        iio.imwrite(part, np.concatenate(pictures, axis=1), extension=".png")


if __name__ == "__main__":
    main()
