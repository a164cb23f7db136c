"""The protocol's 34 actions through our own simulator.

Command: physxnet dataset build experiments/configs/dataset_physxnet.py --out runs/ours
Cost:    653 s of simulation, 1,654 s on a slower machine; 86 MB.
Result:  the set that the shipped weights learned from; sizes and checksums are in
         docs/reproduction.md.
"""

from physxnet_jax.data import DatasetConfig

CONFIG = DatasetConfig(engine="physxnet", splits=("train", "test"))
