"""The 16 actions beyond the protocol, through our own simulator: more to learn from.

Command: physxnet dataset build experiments/configs/dataset_extra.py --out runs/extra
Cost:    645 s of simulation.
Result:  2,597 frames; no result of the paper's protocol uses them unless it says so.
"""

from physxnet_jax.data import DatasetConfig

CONFIG = DatasetConfig(engine="physxnet", splits=("extra",))
