"""The 16 actions beyond the protocol through Blender's cloth.

Command: PHYSXNET_BLENDER=... physxnet dataset build experiments/configs/dataset_blender_extra.py
         --out runs/blender_extra --shard 0/2 (and 1/2 beside it)
Cost:    not measured; by the rate of the protocol (1.0 to 1.3 seconds a frame and garment) 2.2 to
         2.8 hours of one core, half as long in two shards.
Result:  2,597 frames of each garment, cotton, quality 10 without self-collision.
"""

from physxnet_jax.data import DatasetConfig
from physxnet_jax.simulation.blender import BlenderSettings

CONFIG = DatasetConfig(engine="blender", splits=("extra",), blender=BlenderSettings(quality=10))
