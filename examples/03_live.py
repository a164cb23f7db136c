"""A frame in, a frame out: clothes that keep up with a stream of poses.

python examples/03_live.py
"""

import functools
import time

import jax
import numpy as np

import physxnet_jax as px
from physxnet_jax.io import AnimatedMesh
from physxnet_jax.viewer import render_preview

start = time.perf_counter()
dresser = px.make_dresser(["shirt", "trousers"], inference=px.Inference(weights="nano"))
motion = px.load_motion("walk", fps=30)
# The stream is used up: its memory serves the next one.
step = jax.jit(functools.partial(px.clothe_step, fps=30.0), donate_argnums=1)

# Who comes in moving would be told by the first few poses; here the first one is all there is.
stream = px.init_stream(dresser, motion.rotations[0], motion.root[0])
times, shown = [], []
for rotations, root in zip(motion.rotations, motion.root, strict=True):
    began = time.perf_counter()
    stream, cloth = step(dresser, stream, rotations, root)
    jax.block_until_ready(cloth.vertices)
    times.append(1e3 * (time.perf_counter() - began))
    if not bool(cloth.ok):
        raise SystemExit("a pose that isn't finite came in")
    shown.append({name: np.asarray(x) for name, x in cloth.vertices.items()})
print(f"first frame {times[0]:.0f} ms (compilation), then {np.median(times[1:]):.1f} ms each")

whole = px.clothe(dresser, motion.rotations, motion.root, fps=30.0)
gap = max(float(abs(whole[n][-1] - cloth[n]).max()) for n in cloth.vertices)
garments = [
    AnimatedMesh(g.name, np.stack([s[g.name] for s in shown]), np.asarray(g.mesh.faces))
    for g in dresser.garments
]
print("wrote", render_preview("out/live.png", garments, 30.0, strip=6))
print(f"the last frame differs from the whole clip's by {1e6 * gap:.2f} micrometres")
print(f"{time.perf_counter() - start:.0f} s in all, compilation included")
