"""What three networks answer on motion that none has seen: legs of all with other upper bodies.

Command: physxnet dataset build experiments/configs/dataset_taught_a.py --out runs/taught_a
Cost:    see docs/reproduction.md, the dataset.
Result:  cloth for one network to learn from that shall answer as three do; nothing is simulated.
"""

from physxnet_jax.data import DatasetConfig

CONFIG = DatasetConfig(
    engine="network",
    splits=("train", "extra"),
    upper_from=1,
    exaggerate=1.15,
    speed=0.9,
    networks=("local+mirror", "local-muon+mirror", "runs/local-wide/weights+mirror"),
)
