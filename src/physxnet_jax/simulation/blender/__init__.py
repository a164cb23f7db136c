"""Blender's cloth simulator as an external engine; it is the paper's teacher."""

from ._engine import (
    BlenderSettings as BlenderSettings,
    find_blender as find_blender,
    simulate_blender as simulate_blender,
)
