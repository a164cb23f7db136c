"""Training: losses, step, loop, checkpoints."""

from ._checkpoint import Checkpoints as Checkpoints
from ._config import TrainConfig as TrainConfig
from ._data import TrainingData as TrainingData, load_data as load_data
from ._loop import train as train
from ._losses import (
    adversarial_loss as adversarial_loss,
    discriminator_loss as discriminator_loss,
    masked_l1 as masked_l1,
    masked_l2 as masked_l2,
    pooled_l1 as pooled_l1,
    soft_labels as soft_labels,
    vertex_loss as vertex_loss,
)
from ._monitor import map_picture as map_picture, read_metrics as read_metrics
from ._optimizer import (
    make_optimizer as make_optimizer,
    orthogonalize_via_newton_schulz as orthogonalize_via_newton_schulz,
    scale_by_muon as scale_by_muon,
)
from ._problem import (
    LossInputs as LossInputs,
    Problem as Problem,
    configured_loss as configured_loss,
    make_problem as make_problem,
)
from ._step import eval_step as eval_step, train_step as train_step
from ._targets import prepare_targets as prepare_targets
