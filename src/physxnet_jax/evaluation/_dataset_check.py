"""Quality checks of a dataset's actions."""

from typing import SupportsFloat

import numpy as np

from ..data import Sequence
from ..garment import TEMPLATES, Template
from ..simulation import OFF, prepare_scene, slipped
from ._methods import scene_of, skinning
from ._motion_metrics import jitter
from ._penetration import penetration
from ._strain import edge_strain
from ._stress import Finding

# Share of vertices inside the body, pinched ones excluded [1].
_MAX_INSIDE = 0.02
# 99th percentile of strain [1].
_MAX_STRAIN = 0.4
# Jerk of the cloth relative to its skinning [1].
_MAX_JERK_RATIO = 10.0
# Floor for the skinning's jerk in that ratio: a person standing still has no more [m/s^3].
_MIN_JERK = 1.0
_FRAME_STRIDE = 10


def check_sequence(sequence: Sequence, frames: int | None = None) -> list[Finding]:
    """Returns the findings of one action, including those within their bounds.

    Args:
        sequence: The action with its garments.
        frames: Expected number of frames, if known.
    """
    out: list[Finding] = []

    def add(name: str, quantity: str, bound: float, measured: SupportsFloat) -> None:
        out.append(Finding(f"{sequence.name}, {name}", quantity, bound, float(measured)))

    names: list[Template] = [t for t in TEMPLATES if t in sequence.offsets]
    for name in names:
        offsets, worn = sequence.offsets[name], sequence.clothing(name)
        motion, count = sequence.motion, sequence.garment(name).num_vertices
        if frames is not None:
            add(name, "frames missing", 0.0, abs(len(offsets) - frames))
        add(name, "not finite", 0.0, 0.0 if sequence.meta[name]["finite"] else 1.0)
        add(name, "vertices missing", 0.0, abs(offsets.shape[1] - count))
        if offsets.shape[1] != count:
            continue
        add(name, "frame count difference to motion", 0.0, abs(len(offsets) - motion.num_frames))
        if len(offsets) != motion.num_frames:
            continue
        scene = prepare_scene(scene_of(worn))
        skinned = skinning()(motion, worn).positions
        cloth = skinned + offsets
        add(name, "slid along the body, m", OFF, slipped(scene.assembly, motion, cloth).max())
        sampled = np.arange(0, len(cloth), _FRAME_STRIDE)
        seen = penetration(scene.assembly, motion, cloth, frames=sampled, bare_skin=False)
        add(name, "inside the body, share", _MAX_INSIDE, (seen.cloth_inside & ~seen.pinched).mean())
        strain = np.abs(edge_strain(scene.assembly, cloth))
        add(name, "strain, 99 %", _MAX_STRAIN, np.quantile(strain, 0.99))
        still = max(jitter(skinned, motion.fps), _MIN_JERK)
        add(name, "jerk relative to skinning", _MAX_JERK_RATIO, jitter(cloth, motion.fps) / still)
    return out
