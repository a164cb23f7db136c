"""The ladder's rung `nano`: `local_cpu.py` with 8 channels in the first layer.

Command: physxnet train experiments/configs/local_nano_cpu.py --name nano
         --data runs/ours --data runs/mirror --data runs/extra --data runs/extra_mirror
         --data runs/mixed --splits train extra --out runs/nano
Cost:    14 minutes on two cores beside other work: 9,005 steps.
Result:  the rows `nano` of experiments/results/test_errors.md.

The recipe is that of `local_cpu.py`, the data a third of what it has learned from since; mirror
images were simulated, which `TrainConfig.mirror` makes needless.
"""

from physxnet_jax.models import Inputs, ModelConfig
from physxnet_jax.training import TrainConfig

CONFIG = TrainConfig(
    model=ModelConfig(Inputs("local"), resolution=64, width=8),
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
