"""The 16 actions beyond the protocol as a mirror shows them, through our own simulator.

Command: physxnet dataset build experiments/configs/dataset_extra_mirror.py
         --out runs/extra_mirror
Cost:    about 9 minutes on two cores.
Result:  2,597 frames, for the shipped weights alone.
"""

from physxnet_jax.data import DatasetConfig

CONFIG = DatasetConfig(engine="physxnet", splits=("extra",), mirror=True)
