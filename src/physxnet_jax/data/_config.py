"""The configuration of a dataset."""

import dataclasses
from typing import Any, Literal

from ..errors import check_counts, check_numbers
from ..garment import TEMPLATES, Template
from ..simulation import XPBD
from ..simulation.blender import BlenderSettings
from ._outfit import Outfit

SPLITS = ("train", "test", "extra")
"""Splits of the protocol."""

CARD: dict[str, Any] = {
    "licence": "The motion is the CMU Graphics Lab Motion Capture Database's, free for all uses"
    " but not to be sold; what is derived here from it is MIT.",
    "acknowledgement": "The data used in this project was obtained from mocap.cs.cmu.edu. The"
    " database was created with funding from NSF EIA-0196217.",
}


@dataclasses.dataclass(frozen=True)
class DatasetConfig:
    """Settings of a dataset.

    Attributes:
        engine: ``physxnet`` (this package's simulator) or ``blender`` (the paper's).
        splits: Splits of the protocol: ``train``, ``test``, ``extra``.
        templates: Garments, each simulated separately; without outfits.
        outfits: Outfits of the tailor, in place of ``templates``; with the ``physxnet`` engine.
        outfits_each: How many of them each action is simulated in, one after another: the first
            action in the first ones, the second in those that follow, and so on.
        first_outfit: Where the first action begins.
        left_out: Use the frames of the actions' clips that the protocol leaves out instead of
            the actions themselves, see `left_out`.
        mirror: Exchange left and right in every motion.
        speed: Play every motion this many times as fast.
        upper_from: Take spine, arms and head from the action this many places further on in
            the same split; 0 disables this.
        exaggerate: Factor on the deviation of each joint from its mean rotation.
        subdue: Factor that makes of every motion a person who stands almost still, see `subdued`.
        people: Actions simulated side by side, as one batch; with the ``physxnet`` engine. Part of
            the configuration because the last bits of a result depend on its batch.
        solver: Settings of this package's simulator.
        blender: Settings of Blender's simulator.
    """

    engine: Literal["physxnet", "blender"] = "physxnet"
    splits: tuple[str, ...] = ("train", "test")
    templates: tuple[Template, ...] = TEMPLATES
    outfits: tuple[Outfit, ...] = ()
    outfits_each: int = 1
    first_outfit: int = 0
    left_out: bool = False
    mirror: bool = False
    speed: float = 1.0
    upper_from: int = 0
    exaggerate: float = 1.0
    subdue: float = 1.0
    people: int = 1
    solver: XPBD = dataclasses.field(default_factory=XPBD)
    blender: BlenderSettings = dataclasses.field(default_factory=BlenderSettings)

    def __post_init__(self) -> None:
        check_numbers(self, "speed", "exaggerate", "subdue")
        for name, given, known in (
            ("splits", self.splits, SPLITS),
            ("templates", self.templates, TEMPLATES),
        ):
            if not given or set(given) - set(known):
                raise ValueError(f"{name} are {given}; there are {', '.join(known)}.")
        check_counts(self, "people", "outfits_each")
        if self.outfits and (self.engine != "physxnet" or self.templates != TEMPLATES):
            raise ValueError("outfits need the engine 'physxnet', and take the place of templates.")
        if self.outfits_each > max(len(self.outfits), 1) or self.first_outfit < 0:
            raise ValueError(
                f"outfits_each is {self.outfits_each}, first_outfit {self.first_outfit}; there are"
                f" {len(self.outfits)} outfits."
            )
        if self.people > 1 and self.engine != "physxnet":
            raise ValueError(f"people is {self.people}; the engine '{self.engine}' takes 1.")

    def settings(self) -> dict[str, Any]:
        """Settings of the selected engine only."""
        used = self.solver if self.engine == "physxnet" else self.blender
        return {"engine": self.engine, **dataclasses.asdict(used)}
