"""`local_cpu.py` taught from half as much motion again: is it motion that is missing?

Command: physxnet train experiments/configs/local_wide_cpu.py --name local-wide
         --data runs/ours --data runs/extra --data runs/left_out --data runs/mixed
         --data runs/mixed_extra --data runs/mixed_left_out --data runs/varied
         --data runs/wide --data runs/swift --data runs/varied_left_out
         --splits train extra --out runs/local-wide
Cost:    71 minutes on two cores, half of them beside other work: 19,134 steps.
Result:  experiments/results/more_motion.json: 2 % nearer for tops, 1 % for trousers, 1 %
         farther for dresses. Not shipped.
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
