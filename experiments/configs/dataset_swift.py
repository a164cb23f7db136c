"""The legs of every action with the upper body of yet another, a quarter faster.

Command: physxnet dataset build experiments/configs/dataset_swift.py --out runs/swift
Cost:    see docs/reproduction.md, the dataset.
Result:  velocities and accelerations that the other sets, slower or as recorded, don't have.
"""

from physxnet_jax.data import DatasetConfig

CONFIG = DatasetConfig(
    engine="physxnet", splits=("train", "extra"), upper_from=5, exaggerate=1.1, speed=1.25
)
