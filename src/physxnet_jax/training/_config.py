"""What a training run is."""

import dataclasses
from typing import Literal

from ..errors import check_counts, check_numbers
from ..models import ModelConfig


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """Settings of a run; the defaults are the paper's where it gives them.

    Attributes:
        model: The network.
        epochs: Passes over the training frames.
        batch: Frames a step.
        learning_rate: Adam's rate for the generator.
        discriminator_rate: Adam's rate for the discriminator.
        momentum: Adam's b1; 0.5 is usual beside a discriminator.
        optimiser: What the generator learns by: ``adam`` (the paper) or ``muon`` for the
            kernels of its convolutions (their momentum made orthogonal) beside ``adam``
            for all else, which gets as far in fewer steps.
        kernel_rate: Muon's rate for those kernels.
        schedule: ``constant`` (the paper) or ``cosine`` (up over the first 2 % of the
            run, down to zero over the rest).
        l1_weight: lambda_L1 of equation 2.
        squared: Errors are squared in place of the paper's absolute ones: where the same
            motion has several outcomes the network then learns their mean, which is
            what the root of mean squares asks for.
        vertex_share: Share of the L1 loss that is taken at the vertices of the templates,
            where maps are read, instead of at texels: maps then learn to make up for
            what reading them loses. 0 is the paper's; ``local`` only.
        edge_share: Share of the loss at vertices that is taken on the differences along
            the templates' edges, from which strain and folds come.
        scales: The loss at texels is the mean over this many sizes of maps, each half as
            wide as the one before; 1 is the paper's.
        adversarial: Whether there is a discriminator at all.
        discriminator_width: Channels of its first layer.
        mirror: Every action is learned from as a mirror shows it, too.
        seed: Of everything random.
        precision: Of the network's arithmetic; parameters and losses stay float32.
        validation: Names of training actions that are kept from training and measured
            instead; the weights that did best on them are the result. A set that mixes
            bodies (`DatasetConfig.upper_from`) has their upper bodies under other names.
        validate_every: Steps between such measurements.
        patience: Stop after this many measurements without a better one.
        checkpoint_every: Steps between checkpoints.
        max_skipped: Non-finite updates in a row before the run gives up.
    """

    model: ModelConfig = dataclasses.field(default_factory=ModelConfig)
    epochs: int = 150
    batch: int = 8
    learning_rate: float = 2e-4
    discriminator_rate: float = 2e-4
    momentum: float = 0.5
    optimiser: Literal["adam", "muon"] = "adam"
    kernel_rate: float = 2e-2
    schedule: Literal["constant", "cosine"] = "constant"
    l1_weight: float = 100.0
    squared: bool = False
    vertex_share: float = 0.0
    edge_share: float = 0.0
    scales: int = 1
    adversarial: bool = True
    discriminator_width: int = 16
    mirror: bool = False
    seed: int = 0
    precision: Literal["float32", "bfloat16"] = "float32"
    validation: tuple[str, ...] = ()
    validate_every: int = 400
    patience: int = 10
    checkpoint_every: int = 200
    max_skipped: int = 20

    def __post_init__(self) -> None:
        check_counts(self, "epochs", "batch", "discriminator_width", "validate_every")
        check_counts(self, "patience", "checkpoint_every", "max_skipped")
        check_numbers(self, "learning_rate", "discriminator_rate", "kernel_rate")
        check_numbers(self, "l1_weight", zero=True)
        if not 0.0 <= self.momentum < 1.0:
            raise ValueError(f"momentum is {self.momentum}; it lies from 0 to below 1.")
        if not 0.0 <= self.vertex_share <= 1.0:
            raise ValueError(f"vertex_share is {self.vertex_share}; it is a share, 0 to 1.")
        if self.vertex_share and self.model.family != "local":
            raise ValueError("vertex_share needs the local family; the paper's loss has none.")
        if not 0.0 <= self.edge_share <= 1.0:
            raise ValueError(f"edge_share is {self.edge_share}; it is a share, 0 to 1.")
        if self.edge_share and not self.vertex_share:
            raise ValueError("edge_share is a share of vertex_share, which is 0.")
        if self.scales > 1 and self.squared:
            raise ValueError("scales takes absolute errors, squared takes squares; choose one.")
        size = self.model.resolution
        if self.scales < 1 or size % 2 ** (self.scales - 1):
            raise ValueError(
                f"scales is {self.scales}: at least 1, and maps of {size} must halve that often."
            )
