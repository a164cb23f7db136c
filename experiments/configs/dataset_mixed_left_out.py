"""What the protocol leaves out of its clips, with the upper body of another action.

Command: physxnet dataset build experiments/configs/dataset_mixed_left_out.py
         --out runs/mixed_left_out
Cost:    see docs/reproduction.md, the dataset.
Result:  as `dataset_mixed.py`, of the legs of `dataset_left_out.py`.
"""

from physxnet_jax.data import DatasetConfig

CONFIG = DatasetConfig(
    engine="physxnet",
    splits=("train", "extra"),
    left_out=True,
    upper_from=3,
    exaggerate=1.25,
)
