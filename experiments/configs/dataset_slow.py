"""The 22 training actions at four fifths of their speed, through our simulator.

Command: physxnet dataset build experiments/configs/dataset_slow.py --out runs/slow
Cost:    37 minutes of two cores that were busy with other work; 66.3 MB.
Result:  the same poses with other velocities: what depends on which can be told apart.
"""

from physxnet_jax.data import DatasetConfig

CONFIG = DatasetConfig(engine="physxnet", splits=("train",), speed=0.8)
