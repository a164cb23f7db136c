"""The paper's network in full: 256 x 256, 150 epochs, for one CUDA machine.

Command: physxnet train experiments/configs/paper_cuda.py --name paper --data runs/ours
         --out runs/paper_cuda
Cost:    not measured yet, see experiments/gpu_queue.md; the paper took two days.
Result:  what the paper's own settings give on our data.
"""

from physxnet_jax.models import PAPER, ModelConfig
from physxnet_jax.training import TrainConfig

CONFIG = TrainConfig(
    model=ModelConfig(PAPER, resolution=256, width=64),
    epochs=150,
    batch=16,
    learning_rate=2e-4,
    adversarial=True,
    discriminator_width=64,
    precision="bfloat16",
    validation=("kick ball",),
    validate_every=1000,
    patience=30,
    checkpoint_every=1000,
)
