"""What the protocol leaves out of its clips, as `dataset_varied.py` changes the actions.

Command: physxnet dataset build experiments/configs/dataset_varied_left_out.py
         --out runs/varied_left_out
Cost:    see docs/reproduction.md, the dataset.
Result:  as `dataset_mixed_left_out.py`, with other partners, slower and swung wider still.
"""

from physxnet_jax.data import DatasetConfig

CONFIG = DatasetConfig(
    engine="physxnet",
    splits=("train", "extra"),
    left_out=True,
    upper_from=6,
    exaggerate=1.4,
    speed=0.8,
)
