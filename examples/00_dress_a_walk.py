"""A built-in walk in a shirt and trousers, as USD, with a picture of six moments.

python examples/00_dress_a_walk.py
"""

import time

import physxnet_jax as px
from physxnet_jax.viewer import render_preview

began = time.perf_counter()
clip = px.dress("walk", ["shirt", "trousers"], frames=48)
for path in px.write_clip("out/walk.usdc", clip.meshes, clip.fps):
    print("wrote", path)
print("wrote", render_preview("out/walk.png", clip.meshes, clip.fps, strip=6))
for stage in clip.stages:
    print(f"{stage.name:10s} {stage.cold_ms:8.0f} ms the first time")
print("share of vertices inside the body:", clip.inside)
print(f"{time.perf_counter() - began:.0f} s in all, compilation included")
