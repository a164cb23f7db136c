"""The `local` network at a size that trains on two cores: the shipped weights `local`.

Command: physxnet train experiments/configs/local_cpu.py --name local
         --data runs/ours --data runs/mirror --out runs/local
Cost:    about 45 minutes on two cores.
Result:  the rows `local` of experiments/results/test_errors.md.

L1 alone: an adversarial loss costs a second network and isn't aimed at the error.
"""

from physxnet_jax.models import Inputs, ModelConfig
from physxnet_jax.training import TrainConfig

CONFIG = TrainConfig(
    model=ModelConfig(Inputs("local"), resolution=64, width=32),
    epochs=16,
    batch=8,
    learning_rate=3e-3,
    schedule="cosine",
    adversarial=False,
    validation=("kick ball",),
    validate_every=760,
    patience=8,
    checkpoint_every=760,
)
