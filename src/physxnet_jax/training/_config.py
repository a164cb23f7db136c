"""What a training run is."""

import dataclasses

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
        schedule: ``constant`` (the paper) or ``cosine`` (to zero over the run).
        l1_weight: lambda_L1 of equation 2.
        adversarial: Whether there is a discriminator at all.
        discriminator_width: Channels of its first layer.
        seed: Of everything random.
        checkpoint_every: Steps between checkpoints.
        max_skipped: Non-finite updates in a row before the run gives up.
    """

    model: ModelConfig = dataclasses.field(default_factory=ModelConfig)
    epochs: int = 150
    batch: int = 8
    learning_rate: float = 2e-4
    discriminator_rate: float = 2e-4
    schedule: str = "constant"
    l1_weight: float = 100.0
    adversarial: bool = True
    discriminator_width: int = 16
    seed: int = 0
    checkpoint_every: int = 200
    max_skipped: int = 20
