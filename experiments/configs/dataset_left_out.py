"""What the protocol leaves out of the clips of its training actions and of the extra ones.

Command: physxnet dataset build experiments/configs/dataset_left_out.py --out runs/left_out
Cost:    see docs/reproduction.md, the dataset.
Result:  more frames of people who really moved so. Clips of test actions aren't touched.
"""

from physxnet_jax.data import DatasetConfig

CONFIG = DatasetConfig(engine="physxnet", splits=("train", "extra"), left_out=True)
