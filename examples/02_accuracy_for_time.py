"""The same clip by skinning, by two networks and by simulation: time and distance.

python examples/02_accuracy_for_time.py
"""

import numpy as np

import physxnet_jax as px

FRAMES = 32
motion = px.load_motion("punch", fps=30)


def worn(**way):
    """The top in motion, and its time a frame [ms] once all is compiled."""
    px.dress(motion, ["top"], frames=FRAMES, **way)
    clip = px.dress(motion, ["top"], frames=FRAMES, **way)
    stage = next(s for s in clip.stages if s.name in ("network", "skinning", "simulation"))
    return clip.garments[0].positions, stage


truth, stage = worn(method="simulate")
print("way         ms a frame    mm from the simulation")
print(f"simulation  {stage.warm_ms or stage.cold_ms / FRAMES:10.1f}                       0.0")
for name, way in {
    "skinning": {"method": "lbs", "resolve": False},
    "nano": {"weights": "nano"},
    "small": {"weights": "small"},
}.items():
    cloth, stage = worn(**way)
    error = 1e3 * np.sqrt(((cloth - truth) ** 2).sum(axis=2).mean())
    print(f"{name:10s}  {stage.cold_ms / FRAMES:10.1f}                {error:10.1f}")
print("One clip isn't a measurement: the errors of twelve actions are in docs/reproduction.md.")
