"""A rigged character that nobody made for this program, moved by motions, in clothes.

Command: python experiments/foreign_rig.py ../shared/mocap
Cost:    three minutes; it fetches 2 MB from npm (and @gltf-transform/cli).
Result:  experiments/results/foreign_rig.md, shown in docs/own-body.md, and its picture. The
         mannequin of @pmndrs/viverse (MIT licence): 61 shells, VRM's names of bones, mesh and
         clips in files of their own, the mesh compressed. It is moved by a clip of that package
         and by one of CMU's.
"""

import argparse
import base64
import pathlib
import re
import subprocess
import tempfile
import time

import imageio.v3 as iio
import numpy as np

from physxnet_jax.dressing import Inference, dress, load_character
from physxnet_jax.files import atomic_write
from physxnet_jax.viewer import render_frame

PACKAGE = "@pmndrs/viverse@0.2.20"
RESULT = pathlib.Path(__file__).parent / "results/foreign_rig.md"
PICTURE = pathlib.Path(__file__).parents[1] / "docs/foreign-rig.png"
SALSA = "daz/060_12.bvh"
SECONDS = 3.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("mocap", type=pathlib.Path, help="folder of CMU's clips")
    mocap: pathlib.Path = parser.parse_args().mocap
    lines = [
        "| clip | garment | laid on in, s | apart, mm | inside, as predicted, %"
        " | inside, moved out, % |",
        "|---|---|---|---|---|---|",
    ]
    pictures = []
    with tempfile.TemporaryDirectory() as folder:
        files = fetch(pathlib.Path(folder))
        for name, motion, outfit in (
            ("run", files["run"], ("top", "bottom")),
            ("salsa dance", mocap / SALSA, ("dress",)),
        ):
            began = time.perf_counter()
            person = load_character(files["mannequin"], motion=motion, frames=int(30 * SECONDS))
            spent = time.perf_counter() - began
            raw = dress(person, outfit, method="network", inference=Inference(collisions=False))
            clip = dress(person, outfit, method="network")
            for g in clip.garments:
                lines.append(
                    f"| {name} | {g.name} | {spent:.0f} | {1e3 * person.apart:.0f} |"
                    f" {100 * raw.inside[g.name]:.2f} | {100 * clip.inside[g.name]:.2f} |"
                )
            for share in (0.1, 0.5, 0.9):
                frame = int(share * clip.num_frames)
                pictures.append(render_frame(clip.meshes, frame, size=(300, 400)))
    with atomic_write(RESULT) as part:
        part.write_text("\n".join(lines) + "\n")
    print("\n".join(lines))  # noqa: T201
    with atomic_write(PICTURE) as part:
        iio.imwrite(part, np.concatenate(pictures, axis=1), extension=".png")


def fetch(folder: pathlib.Path) -> dict[str, pathlib.Path]:
    """The package's models, unpacked and uncompressed, by name."""
    subprocess.run(["npm", "pack", "--silent", PACKAGE], cwd=folder, check=True)
    (archive,) = folder.glob("*.tgz")
    subprocess.run(["tar", "xzf", archive.name], cwd=folder, check=True)
    out = {}
    for name in ("mannequin", "run"):
        text = (folder / f"package/dist/assets/{name}.js").read_text()
        data = re.search(r"base64,([A-Za-z0-9+/=]+)", text)
        assert data is not None
        out[name] = folder / f"{name}.glb"
        out[name].write_bytes(base64.b64decode(data[1]))
    plain = folder / "plain.glb"
    tool = ["npx", "--yes", "@gltf-transform/cli", "copy"]
    subprocess.run([*tool, out["mannequin"], plain], check=True)
    return out | {"mannequin": plain}


if __name__ == "__main__":
    main()
