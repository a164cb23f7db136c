"""The 22 training actions as a mirror shows them, through our own simulator.

Command: physxnet dataset build experiments/configs/dataset_mirror.py --out runs/mirror
Cost:    778 s of simulation.
Result:  twice as much to learn from, of the same actions. Simulated, not reflected: the
         garments' meshes aren't quite the same on both sides.
"""

from physxnet_jax.data import DatasetConfig

CONFIG = DatasetConfig(engine="physxnet", splits=("train",), mirror=True)
