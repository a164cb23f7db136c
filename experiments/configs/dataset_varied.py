"""The legs of every action with the upper body of another, slower and swung wider still.

Command: physxnet dataset build experiments/configs/dataset_varied.py --out runs/varied
Cost:    see docs/reproduction.md, the dataset.
Result:  as `dataset_mixed.py` and `dataset_mixed_extra.py`, with other partners and other
         speeds: how far cloth moves must not be told from how fast its wearer does.
"""

from physxnet_jax.data import DatasetConfig

CONFIG = DatasetConfig(
    engine="physxnet", splits=("train", "extra"), upper_from=11, exaggerate=1.4, speed=0.8
)
