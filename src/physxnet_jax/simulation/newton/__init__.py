"""Newton's cloth simulator as an external engine, in a separate process; never imported."""

from ._engine import (
    NewtonSettings as NewtonSettings,
    find_newton as find_newton,
    simulate_newton as simulate_newton,
)
