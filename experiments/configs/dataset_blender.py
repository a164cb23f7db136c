"""The protocol's 34 actions through Blender's cloth, the paper's own engine.

Command: PHYSXNET_BLENDER=... physxnet dataset build experiments/configs/dataset_blender.py
         --out runs/blender --shard 0/2 (and 1/2 beside it)
Cost:    1.0 to 1.3 seconds a frame and garment, so 4.6 hours of one core or half as long in
         two shards. 86 of the 102 garments are built (13,411 s beside other work): all tops
         and trousers, the dress in the test actions and in six of training.
Result:  cotton preset, quality 10 without self-collision. Sleeves may come off arms that
         pass close to the body.
"""

from physxnet_jax.data import DatasetConfig
from physxnet_jax.simulation.blender import BlenderSettings

CONFIG = DatasetConfig(
    engine="blender", splits=("train", "test"), blender=BlenderSettings(quality=10)
)
