"""The paper's network of paper_cpu.py for five times as long: does it learn too little?

Command: physxnet train experiments/configs/paper_25_cpu.py --name paper-25 --data runs/ours
         --out runs/paper-25
Cost:    20 minutes on two cores beside other work: it stopped after 6,840 of 9,600 steps.
Result:  best on its validation action after 2,280 steps, worse from there on; on the test
         actions experiments/results/paper_longer.json, beside `paper`.
"""

from physxnet_jax.models import PAPER, ModelConfig
from physxnet_jax.training import TrainConfig

CONFIG = TrainConfig(
    model=ModelConfig(PAPER, resolution=64, width=16),
    epochs=25,
    batch=8,
    learning_rate=1e-3,
    schedule="cosine",
    adversarial=True,
    validation=("kick ball",),
    validate_every=380,
    patience=12,
    checkpoint_every=380,
)
