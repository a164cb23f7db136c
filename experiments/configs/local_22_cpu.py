"""The `local` network from the paper's 22 training actions alone, and their mirror images.

Command: physxnet train experiments/configs/local_22_cpu.py --name local-22
         --data runs/ours --data runs/mirror --out runs/local-22
Cost:    about 45 minutes on two cores.
Result:  the rows `local-22` of experiments/results/test_errors.md.
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
