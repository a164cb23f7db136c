"""The legs of every action with the upper body of yet another, swung half as far again.

Command: physxnet dataset build experiments/configs/dataset_wide.py --out runs/wide
Cost:    see docs/reproduction.md, the dataset.
Result:  poses at the edge of what the test actions ask for: high legs, raised arms.
"""

from physxnet_jax.data import DatasetConfig

CONFIG = DatasetConfig(engine="physxnet", splits=("train", "extra"), upper_from=15, exaggerate=1.5)
