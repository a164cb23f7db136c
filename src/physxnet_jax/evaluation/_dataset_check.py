"""What is wrong with a dataset's action, if anything."""

from typing import SupportsFloat

import numpy as np

from ..data import Sequence
from ..garment import TEMPLATES, Template, template
from ..simulation import Scene, prepare_scene
from ._methods import skinning
from ._motion_metrics import jitter
from ._penetration import penetration
from ._strain import edge_strain
from ._stress import Finding

# Cloth farther from its skinning than this has come off or exploded [m].
_FAR = 0.6
# Share of vertices inside the body that have room outside [1].
_INSIDE = 0.02
# 99th percentile of strain [1].
_STRAIN = 0.4
# Jerk of the cloth over that of its skinning [1].
_JITTER = 10.0
# Jerk of a person who stands still, or less [m/s^3]: cloth on one needn't be stiller.
_STILL = 1.0
_EVERY = 10


def check_sequence(sequence: Sequence, frames: int | None = None) -> list[Finding]:
    """Findings of one action, those within their bounds included.

    Args:
        sequence: The action with its garments.
        frames: How many frames it should have, if known.
    """
    out: list[Finding] = []

    def find(name: str, quantity: str, bound: float, measured: SupportsFloat) -> None:
        out.append(Finding(f"{sequence.name}, {name}", quantity, bound, float(measured)))

    names: list[Template] = [t for t in TEMPLATES if t in sequence.offsets]
    for name in names:
        offsets = sequence.offsets[name]
        motion = sequence.motion
        if frames is not None:
            find(name, "frames missing", 0.0, abs(len(offsets) - frames))
        find(name, "not finite", 0.0, 0.0 if sequence.meta[name]["finite"] else 1.0)
        find(name, "vertices missing", 0.0, abs(offsets.shape[1] - template(name).num_vertices))
        find(name, "largest offset, m", _FAR, np.linalg.norm(offsets, axis=2).max())
        if offsets.shape[1] != template(name).num_vertices:
            continue
        find(name, "frames unlike the motion's", 0.0, abs(len(offsets) - motion.num_frames))
        if len(offsets) != motion.num_frames:
            continue
        scene = prepare_scene(Scene((template(name),)))
        skinned = skinning()(motion, name).positions
        cloth = skinned + offsets
        looked = np.arange(0, len(cloth), _EVERY)
        seen = penetration(scene.assembly, motion, cloth, frames=looked, bare_skin=False)
        find(name, "inside the body, share", _INSIDE, (seen.cloth_inside & ~seen.pinched).mean())
        strain = np.abs(edge_strain(scene.assembly, cloth))
        find(name, "strain, 99 %", _STRAIN, np.quantile(strain, 0.99))
        still = max(jitter(skinned, motion.fps), _STILL)
        find(name, "jerk over that of skinning", _JITTER, jitter(cloth, motion.fps) / still)
    return out
