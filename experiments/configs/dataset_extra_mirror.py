"""The 16 actions beyond the protocol as a mirror shows them, through our own simulator.

Command: physxnet dataset build experiments/configs/dataset_extra_mirror.py
         --out runs/extra_mirror
Cost:    11 minutes of one core: 685 s of simulation.
Result:  2,597 frames, for the shipped weights alone.
"""

from physxnet_jax.data import DatasetConfig

CONFIG = DatasetConfig(engine="physxnet", splits=("extra",), mirror=True)
