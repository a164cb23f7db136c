"""The curves by which a garment holds on to the body."""

import numpy as np
from jaxtyping import Int

from ..geometry import boundary_loops
from ._garment import Garment


def holding_loops(garment: Garment) -> dict[str, Int[np.ndarray, " vertices"]]:
    """Vertices of the curves that hold a garment up, by name.

    Of a tailored garment these are its elastic bands, or its neckline; of others, the border that
    lies highest at rest. Cuffs aren't among them: wide ones slide along the arm in every motion.

    Args:
        garment: The garment.

    Returns:
        Vertices of each curve; nothing for a mesh without a border.
    """
    named = [n for n in ("waist", "top", "neckline") if n in garment.elastic or n == "neckline"]
    out = {n: np.unique(np.asarray(garment.loops[n])) for n in named if n in garment.loops}
    if not out:
        # Fixed curves are no bands any more, but hold all the same.
        held = [n for n in ("top", "waist") if n in garment.loops]
        out = {n: np.unique(np.asarray(garment.loops[n])) for n in held[:1]}
    if out:
        return out
    height = np.asarray(garment.mesh.vertices)[:, 1]
    loops = boundary_loops(np.asarray(garment.mesh.faces))
    if not loops:
        return {}
    return {"upper border": np.sort(max(loops, key=lambda loop: height[loop].mean()))}
