"""The protocol's 34 actions through Blender's cloth, the paper's own engine.

Command: PHYSXNET_BLENDER=... taskset -c 0 physxnet dataset build
         experiments/configs/dataset_blender.py --out runs/blender --shard 0/2
         (and -c 1, 1/2 beside it)
Cost:    seconds a frame: trousers 0.65, dress 0.93 with nothing else running; top 1.17,
         trousers 1.02 beside other work and not bound to cores. 15,022 s in all, of both kinds.
Result:  cotton preset, quality 10 without self-collision. Sleeves may come off arms that
         pass close to the body.
"""

from physxnet_jax.data import DatasetConfig
from physxnet_jax.simulation.blender import BlenderSettings

CONFIG = DatasetConfig(
    engine="blender", splits=("train", "test"), blender=BlenderSettings(quality=10)
)
