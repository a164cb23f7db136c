"""The paper's network at a size that trains on two cores: the shipped weights `paper`.

Command: physxnet train experiments/configs/paper_cpu.py --name paper --data runs/ours
         --out runs/paper
Cost:    about 6 minutes on two cores.
Result:  the rows `paper` of experiments/results/test_errors.md; with --data runs/blender the
         rows `paper-blender`.

World frame, 18 channels, batch norm, adversarial and L1 loss, soft and flipped labels, as
in the paper. Smaller are the maps (64 x 64 for 256 x 256), the width and the number of
epochs (5 for 150): paper_cuda.py has them in full.
"""

from physxnet_jax.models import PAPER, ModelConfig
from physxnet_jax.training import TrainConfig

CONFIG = TrainConfig(
    model=ModelConfig(PAPER, resolution=64, width=16),
    epochs=5,
    batch=8,
    learning_rate=1e-3,
    schedule="cosine",
    adversarial=True,
    validation=("kick ball",),
    validate_every=380,
    patience=12,
    checkpoint_every=380,
)
