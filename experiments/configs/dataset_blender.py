"""The protocol's 34 actions through Blender's cloth, the paper's own engine.

Command: PHYSXNET_BLENDER=... physxnet dataset build experiments/configs/dataset_blender.py
         --out runs/blender --shard 0/2 (and 1/2 beside it)
Cost:    not built in full yet; estimated at 5 hours of one core. The top in the twelve
         test actions took 3,432 s beside other work.
Result:  cotton preset, quality 10 without self-collision. Sleeves may come off arms that
         pass close to the body.
"""

from physxnet_jax.data import DatasetConfig
from physxnet_jax.simulation.blender import BlenderSettings

CONFIG = DatasetConfig(
    engine="blender", splits=("train", "test"), blender=BlenderSettings(quality=10)
)
