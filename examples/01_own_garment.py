"""A garment file of unknown unit and orientation: looked at, mended, worn.

    python examples/01_own_garment.py [FILE.obj]

Without a file it makes one: the template of trousers in centimetres with Z up.
"""

import pathlib
import sys
import time

import numpy as np

import physxnet_jax as px
from physxnet_jax.io import write_obj
from physxnet_jax.viewer import render_preview

began = time.perf_counter()
out = pathlib.Path("out")
out.mkdir(exist_ok=True)
if len(sys.argv) > 1:
    file = pathlib.Path(sys.argv[1])
else:
    file = out / "found_somewhere.obj"
    mesh = px.template("bottom").mesh
    x, y, z = 100 * np.asarray(mesh.vertices).T
    write_obj(file, np.stack([x, -z, y], axis=1), np.asarray(mesh.faces))

found = px.inspect_garment(file)
print(found.verdict)
for line in found.problems:
    print("wrong:", line)
fitted = out / f"{file.stem}_fitted.obj"
steps, result = px.fit_garment(file, fitted)
print(*steps, sep="\n")
print(f"dressed by '{result.template}', {100 * result.hit_rate:.0f} % of rays meet the body")
clip = px.dress("walk", [fitted], frames=16)
for path in px.write_clip(out / "own_garment.npz", clip.meshes, clip.fps):
    print("wrote", path)
print("wrote", render_preview(out / "own_garment.png", clip.meshes, clip.fps, strip=4))
print(f"{time.perf_counter() - began:.0f} s in all, compilation included")
