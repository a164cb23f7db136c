"""Blender's cloth as a second engine, out of process: it is the paper's own teacher."""

from ._engine import (
    BlenderSettings as BlenderSettings,
    find_blender as find_blender,
    simulate_blender as simulate_blender,
)
