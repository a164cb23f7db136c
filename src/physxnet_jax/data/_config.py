"""What a dataset is made of."""

import dataclasses
from typing import Any, Literal

from ..errors import check_numbers
from ..garment import TEMPLATES, Template
from ..simulation import XPBD
from ..simulation.blender import BlenderSettings

SPLITS = ("train", "test", "extra")
"""Parts of the protocol."""

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
        engine: ``physxnet`` (this package's simulator), ``blender`` (the paper's) or
            ``network``: what trained networks answer, for another one to learn from.
        splits: Of the protocol: ``train``, ``test``, ``extra``.
        templates: Garments, each simulated by itself.
        left_out: Not the actions themselves, but what the protocol leaves out of their
            clips, see `left_out`.
        mirror: Left and right of every motion are exchanged.
        speed: Every motion is played this many times as fast.
        upper_from: Spine, arms and head are taken from the action this many places
            further on in the same split; 0 leaves them.
        exaggerate: Joints turn this many times as far from their mean rotation.
        solver: Settings of our simulator.
        blender: Settings of Blender's.
        networks: Names or folders of weights whose mean answer is stored.
    """

    engine: Literal["physxnet", "blender", "network"] = "physxnet"
    splits: tuple[str, ...] = ("train", "test")
    templates: tuple[Template, ...] = TEMPLATES
    left_out: bool = False
    mirror: bool = False
    speed: float = 1.0
    upper_from: int = 0
    exaggerate: float = 1.0
    solver: XPBD = dataclasses.field(default_factory=XPBD)
    blender: BlenderSettings = dataclasses.field(default_factory=BlenderSettings)
    networks: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_numbers(self, "speed", "exaggerate")
        for name, told, known in (
            ("splits", self.splits, SPLITS),
            ("templates", self.templates, TEMPLATES),
        ):
            if not told or set(told) - set(known):
                raise ValueError(f"{name} are {told}; there are {', '.join(known)}.")
        if (self.engine == "network") != bool(self.networks):
            raise ValueError(f"engine {self.engine} with networks {self.networks}: name both.")

    def settings(self) -> dict[str, Any]:
        """What the engine is told, and nothing of the others."""
        if self.engine == "network":
            return {"engine": self.engine, "networks": list(self.networks)}
        used = self.solver if self.engine == "physxnet" else self.blender
        return {"engine": self.engine, **dataclasses.asdict(used)}
