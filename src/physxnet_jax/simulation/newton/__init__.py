"""Newton's cloth as another engine, in a process of its own; never imported."""

from ._engine import (
    NewtonSettings as NewtonSettings,
    find_newton as find_newton,
    simulate_newton as simulate_newton,
)
