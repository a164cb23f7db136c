"""The `local` network at a size that trains on two cores: the shipped weights `local`.

Command: physxnet train experiments/configs/local_cpu.py --name local
         --data runs/ours --data runs/mirror --data runs/extra --data runs/extra_mirror
         --data runs/mixed --splits train extra --out runs/local
Cost:    54 minutes on two cores beside other work: 9,005 steps.
Result:  the rows `local` of experiments/results/test_errors.md. It has seen 16 actions that
         the paper's protocol doesn't have; `local_22_cpu.py` has not.

L1 alone: an adversarial loss costs a second network and isn't aimed at the error.
"""

from physxnet_jax.models import Inputs, ModelConfig
from physxnet_jax.training import TrainConfig

CONFIG = TrainConfig(
    model=ModelConfig(Inputs("local"), resolution=64, width=32),
    epochs=5,
    batch=8,
    learning_rate=3e-3,
    schedule="cosine",
    adversarial=False,
    vertex_share=0.7,
    validation=("kick ball",),
    validate_every=760,
    patience=12,
    checkpoint_every=760,
)
