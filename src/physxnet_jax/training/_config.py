"""The configuration of a training run."""

import dataclasses
from typing import Literal

from ..errors import check_choices, check_counts, check_numbers
from ..models import ModelConfig


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """Settings of a training run; defaults are the paper's where it gives them.

    Attributes:
        model: The network.
        epochs: Passes over the training frames; also a part of one.
        batch: Frames per step; of each template with ``model.conditions``, where every sample has
            a garment of its own.
        learning_rate: Adam's learning rate for the generator.
        discriminator_rate: Adam's learning rate for the discriminator.
        b1: Adam's b1; 0.5 is usual with a discriminator.
        optimizer: The generator's optimizer: ``adam`` (the paper) or ``muon``, which
            orthogonalises the momentum of convolution kernels, uses ``adam`` for all other
            parameters, and gets as far in fewer steps.
        muon_learning_rate: Muon's learning rate for those kernels.
        schedule: ``constant`` (the paper) or ``cosine`` (warmup over the first 2 % of the
            run, then decay to zero).
        l1_weight: lambda_L1 of equation 2.
        loss: ``l1``: the paper's absolute errors; ``l2``: squared errors. Where the same
            motion has several outcomes, the network then learns their mean, which minimises
            the root mean square error.
        vertex_share: Share of the loss that is taken at the templates' vertices, where maps
            are sampled, instead of at texels. Maps then learn to compensate for the sampling
            error. 0 is the paper's; ``local`` only.
        edge_share: Share of the loss at vertices that applies to differences along the
            templates' edges, which determine strain and folds.
        patch_share: Share of the loss that is taken at means over patches of 8 cm instead of at
            vertices: folds within a patch are chaotic, their mean isn't. Only with
            ``model.conditions``.
        elastic_weight: Weight of the cloth's elastic energy, relative to lifting the garment by
            1 cm, beside an error of 1 cm: what an error lets open between neighbouring vertices,
            the energy of springs and hinges closes. Only with ``model.conditions`` and ``l1``.
        pyramid_levels: The loss at texels is the mean over this many resolutions of maps, each
            half the previous one; 1 is the paper's.
        adversarial: Whether to train with a discriminator.
        discriminator_width: Channels of the discriminator's first layer.
        mirror_augmentation: Also train on the mirror image of every action.
        start: Weights to go on from, a name or a folder, with their scales of inputs and outputs;
            random ones if empty.
        learned: Templates whose decoders alone are learned, in evaluation mode: the encoder, other
            decoders and batch statistics stay those of ``start``, and the data need hold no other
            garments. Everything is learned if empty. Only with ``model.conditions``.
        blend: Share of what was learned in the resulting parameters; the rest is ``start``'s
            (Wortsman et al., Robust fine-tuning of zero-shot models, 2022). Only with
            ``learned``.
        seed: Seed of all random numbers.
        precision: Precision of the network's arithmetic; parameters and losses stay float32.
        validation: Names of training actions that are held out for validation. The weights
            with the lowest error on them are the result. A dataset that mixes bodies
            (`DatasetConfig.upper_from`) contains their upper bodies under other names.
        validate_every: Steps between validations.
        patience: Stop after this many validations without improvement.
        checkpoint_every: Steps between checkpoints.
        frames_in_memory: Frames of cloth in memory. A larger dataset is read while it is learned
            from, half as many frames at a time, in another order every epoch.
        max_skipped: Abort after this many consecutive non-finite updates.
    """

    model: ModelConfig = dataclasses.field(default_factory=ModelConfig)
    epochs: int | float = 150
    batch: int = 8
    learning_rate: float = 2e-4
    discriminator_rate: float = 2e-4
    b1: float = 0.5
    optimizer: Literal["adam", "muon"] = "adam"
    muon_learning_rate: float = 2e-2
    schedule: Literal["constant", "cosine"] = "constant"
    l1_weight: float = 100.0
    loss: Literal["l1", "l2"] = "l1"
    vertex_share: float = 0.0
    edge_share: float = 0.0
    patch_share: float = 0.0
    elastic_weight: float = 0.0
    pyramid_levels: int = 1
    adversarial: bool = True
    discriminator_width: int = 16
    mirror_augmentation: bool = False
    start: str = ""
    learned: tuple[str, ...] = ()
    blend: float = 1.0
    seed: int = 0
    precision: Literal["float32", "bfloat16"] = "float32"
    validation: tuple[str, ...] = ()
    validate_every: int = 400
    patience: int = 10
    checkpoint_every: int = 200
    frames_in_memory: int = 20_000
    max_skipped: int = 20

    def __post_init__(self) -> None:
        check_choices(self, "optimizer", "schedule", "loss")
        check_counts(self, "batch", "discriminator_width", "validate_every")
        check_counts(self, "patience", "checkpoint_every", "frames_in_memory", "max_skipped")
        check_numbers(self, "epochs", "learning_rate", "discriminator_rate", "muon_learning_rate")
        check_numbers(self, "l1_weight", "elastic_weight", zero=True)
        if not 0.0 <= self.b1 < 1.0:
            raise ValueError(f"b1 is {self.b1}; it must be at least 0 and below 1.")
        if not 0.0 <= self.vertex_share <= 1.0:
            raise ValueError(f"vertex_share is {self.vertex_share}; it must be from 0 to 1.")
        if self.vertex_share and self.model.family != "local":
            raise ValueError("vertex_share needs the local family; the paper's has no vertex loss.")
        if not 0.0 <= self.edge_share <= 1.0:
            raise ValueError(f"edge_share is {self.edge_share}; it must be from 0 to 1.")
        if self.edge_share and not self.vertex_share:
            raise ValueError("edge_share is a share of vertex_share, which is 0.")
        if not 0.0 <= self.patch_share <= 1.0:
            raise ValueError(f"patch_share is {self.patch_share}; it must be from 0 to 1.")
        if self.patch_share and not self.model.conditions:
            raise ValueError("patch_share needs model.conditions.")
        if self.elastic_weight and not self.model.conditions:
            raise ValueError("elastic_weight needs model.conditions.")
        if self.elastic_weight and self.loss != "l1":
            raise ValueError(f"elastic_weight needs loss='l1', but loss is '{self.loss}'.")
        if self.model.conditions and self.adversarial:
            raise ValueError(
                "conditions: every sample has a garment of its own, whose vertices alone are"
                " compared; set adversarial = false."
            )
        if self.pyramid_levels > 1 and self.loss == "l2":
            raise ValueError(
                "pyramid_levels above 1 needs loss='l1', but loss is 'l2'; choose one."
            )
        unknown = set(self.learned) - set(self.model.templates)
        if unknown or (self.learned and not (self.start and self.model.conditions)):
            raise ValueError(
                f"learned is {self.learned}; it names templates of model.templates, and needs"
                " model.conditions and weights to start from."
            )
        if not 0.0 < self.blend <= 1.0 or (self.blend < 1.0 and not self.learned):
            raise ValueError(
                f"blend is {self.blend}; it must be above 0 and at most 1, and 1 without learned."
            )
        size = self.model.resolution
        if self.pyramid_levels < 1 or size % 2 ** (self.pyramid_levels - 1):
            raise ValueError(
                f"pyramid_levels is {self.pyramid_levels}; it must be at least 1, and maps of"
                f" {size} must halve that often."
            )

    @property
    def templates(self) -> tuple[str, ...]:
        """Templates that are learned, in the order of the model."""
        return tuple(t for t in self.model.templates if not self.learned or t in self.learned)
