"""The legs of each extra action with the upper body of another, swung wider.

Command: physxnet dataset build experiments/configs/dataset_mixed_extra.py --out runs/mixed_extra
Cost:    see docs/reproduction.md, the dataset.
Result:  as `dataset_mixed.py`, of the 16 actions that the protocol doesn't have.
"""

from physxnet_jax.data import DatasetConfig

CONFIG = DatasetConfig(engine="physxnet", splits=("extra",), upper_from=5, exaggerate=1.25)
