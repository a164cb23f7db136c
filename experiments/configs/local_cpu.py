"""The `local` network at a size that trains on two cores: the shipped weights `local`.

Command: physxnet train experiments/configs/local_cpu.py --name local
         --data runs/ours --data runs/extra --data runs/left_out --data runs/mixed
         --data runs/mixed_extra --data runs/mixed_left_out --data runs/varied
         --splits train extra --out runs/local
Cost:    27 minutes on two cores, some of it beside other work: 12,176 steps.
Result:  the rows `local` of experiments/results/test_errors.md. It has seen 16 actions that
         the paper's protocol doesn't have, what the protocol leaves out of its clips, and
         both mixed, slowed and exaggerated; `local_22_cpu.py` has not.

L1 alone: an adversarial loss costs a second network and isn't aimed at the error.
"""

from physxnet_jax.models import Inputs, ModelConfig
from physxnet_jax.training import TrainConfig

CONFIG = TrainConfig(
    model=ModelConfig(Inputs("local"), resolution=64, width=32),
    epochs=2,
    batch=8,
    learning_rate=3e-3,
    schedule="cosine",
    adversarial=False,
    vertex_share=0.7,
    mirror=True,
    validation=("kick ball",),
    validate_every=1000,
    patience=12,
    checkpoint_every=500,
)
