"""The legs of each training action with the upper body of another, swung wider.

Command: physxnet dataset build experiments/configs/dataset_mixed.py --out runs/mixed
Cost:    see docs/reproduction.md, the dataset.
Result:  poses that no clip has: what the cloth of the legs does shouldn't depend on which
         arms go with them, and some test actions swing further than any training action.
"""

from physxnet_jax.data import DatasetConfig

CONFIG = DatasetConfig(engine="physxnet", splits=("train",), upper_from=7, exaggerate=1.25)
