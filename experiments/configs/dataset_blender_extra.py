"""The 16 actions beyond the protocol through Blender's cloth.

Command: PHYSXNET_BLENDER=... taskset -c 0 physxnet dataset build
         experiments/configs/dataset_blender_extra.py --out runs/blender_extra --shard 0/2
         (and -c 1, 1/2 beside it)
Cost:    10,514 s in all beside other work and not bound to cores, 1.35 s a frame and garment.
Result:  2,597 frames of each garment, cotton, quality 10 without self-collision.
"""

from physxnet_jax.data import DatasetConfig
from physxnet_jax.simulation.blender import BlenderSettings

CONFIG = DatasetConfig(engine="blender", splits=("extra",), blender=BlenderSettings(quality=10))
