"""The same clip by skinning, by networks and by simulation: time, distance and lengths.

python examples/02_accuracy_for_time.py
"""

import time

import numpy as np

import physxnet_jax as px
from physxnet_jax.geometry import mesh_edges
from physxnet_jax.viewer import render_columns

began = time.perf_counter()
FRAMES = 32
motion = px.load_motion("punch", fps=30)


def worn(**way):
    """The shirt in motion, and its time a frame [ms] once all is compiled."""
    px.dress(motion, ["shirt"], frames=FRAMES, **way)
    clip = px.dress(motion, ["shirt"], frames=FRAMES, **way)
    computed = ("network", "skinning", "guided simulation", "simulation")
    stage = next(s for s in clip.stages if s.name in computed)
    return clip, stage


def stretched(cloth):
    """How far one edge in a hundred is from its length [%]."""
    a, b = mesh_edges(shirt.faces).vertices.T
    length, rest = (np.linalg.norm(x[..., a, :] - x[..., b, :], axis=-1) for x in (cloth, at_rest))
    return 100 * np.quantile(np.abs(length / rest - 1), 0.99)


shirt = px.tailor("shirt").mesh
at_rest = np.asarray(shirt.vertices)
simulated, stage = worn(method="simulate")
truth = simulated.garments[0].positions
pictures = {"simulation": simulated.meshes}
print("method                ms a frame    mm from the simulation    an edge in a hundred off by")
took = stage.warm_ms or stage.cold_ms / FRAMES
print(f"simulation            {took:10.1f}                       0.0    {stretched(truth):25.0f} %")
for name, way in {
    "skinning": {"method": "lbs", "inference": px.Inference(collisions=False)},
    "nano": {"method": "network", "inference": px.Inference(weights="nano")},
    "base": {"method": "network"},
    "base, guided": {"method": "guided"},
}.items():
    clip, stage = worn(**way)
    cloth, pictures[name] = clip.garments[0].positions, clip.meshes
    error = 1e3 * np.sqrt(((cloth - truth) ** 2).sum(axis=2).mean())
    print(
        f"{name:21s} {stage.cold_ms / FRAMES:10.1f}                {error:10.1f}"
        f"    {stretched(cloth):25.0f} %"
    )
print("wrote", render_columns("out/accuracy.png", pictures, 30.0, strip=3))
print(f"{time.perf_counter() - began:.0f} s in all, compilation included")
print("One clip isn't a measurement: the errors of twelve actions are in docs/reproduction.md.")
