"""The protocol's 34 actions through our own simulator.

Command: physxnet dataset build experiments/configs/dataset_physxnet.py --out runs/ours
Cost:    11 minutes of two cores (653 s of simulation), 28 on a slower machine; 86 MB.
Result:  the set that the shipped weights learned from; sizes and checksums are in
         docs/reproduction.md.
"""

from physxnet_jax.data import DatasetConfig

CONFIG = DatasetConfig(engine="physxnet", splits=("train", "test"))
