"""Training: losses, step, loop, checkpoints."""

from ._batches import (
    Frames as Frames,
    batch_indices as batch_indices,
    load_frames as load_frames,
    take as take,
    teaches as teaches,
    usable_garment as usable_garment,
)
from ._checkpoint import Checkpoints as Checkpoints
from ._config import TrainConfig as TrainConfig
from ._loop import prepare_surface as prepare_surface, train as train
from ._losses import (
    adversarial_loss as adversarial_loss,
    discriminator_loss as discriminator_loss,
    masked_l1 as masked_l1,
    masked_l2 as masked_l2,
    pooled_l1 as pooled_l1,
    soft_labels as soft_labels,
    vertex_loss as vertex_loss,
)
from ._optimiser import (
    make_optimiser as make_optimiser,
    orthogonalise as orthogonalise,
    scale_by_orthogonal_momentum as scale_by_orthogonal_momentum,
)
from ._step import (
    ClothTables as ClothTables,
    Steps as Steps,
    TrainState as TrainState,
    make_step as make_step,
)
from ._watch import map_picture as map_picture, read_metrics as read_metrics
