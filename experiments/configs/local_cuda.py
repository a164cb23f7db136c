"""The `local` network at full size, for one CUDA machine.

Command: physxnet train experiments/configs/local_cuda.py --name local
         --data runs/ours --data runs/extra --data runs/left_out --data runs/mixed
         --data runs/mixed_extra --data runs/mixed_left_out --data runs/varied
         --splits train extra --out runs/local_cuda
Cost:    not measured yet, see experiments/gpu_queue.md.
Result:  what more texels, channels and epochs are worth.
"""

from physxnet_jax.models import Inputs, ModelConfig
from physxnet_jax.training import TrainConfig

CONFIG = TrainConfig(
    model=ModelConfig(Inputs("local"), resolution=128, width=64),
    epochs=60,
    batch=16,
    learning_rate=2e-3,
    schedule="cosine",
    adversarial=False,
    vertex_share=0.7,
    mirror=True,
    precision="bfloat16",
    validation=("kick ball",),
    validate_every=1000,
    patience=20,
    checkpoint_every=1000,
)
