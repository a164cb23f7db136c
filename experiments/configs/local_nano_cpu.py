"""The ladder's rung `nano`: `local_cpu.py` with 8 channels in the first layer.

Command: physxnet train experiments/configs/local_nano_cpu.py --name nano
         --data runs/ours --data runs/extra --data runs/left_out --data runs/mixed
         --data runs/mixed_extra --data runs/mixed_left_out --data runs/varied
         --splits train extra --out runs/nano
Cost:    28 minutes of one core beside other work: 12,176 steps.
Result:  the rows `nano` of experiments/results/test_errors.md: the recipe and the data of
         `local_cpu.py`.
"""

from physxnet_jax.models import Inputs, ModelConfig
from physxnet_jax.training import TrainConfig

CONFIG = TrainConfig(
    model=ModelConfig(Inputs("local"), resolution=64, width=8),
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
