"""The unit of a person's mesh, inferred from the person's height."""

UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "inches": 0.0254}
"""Units in which programs write persons [m]."""

# Smallest and largest height of a person, child or adult [m].
_HEIGHTS = (0.8, 2.6)


def unit_of_person(height: float) -> str | None:
    """The unit in which this is a person's height; None if it is so in none.

    Example:
        >>> unit_of_person(172.0), unit_of_person(17.0)
        ('cm', None)
    """
    low, high = _HEIGHTS
    return next((name for name, scale in UNITS.items() if low <= scale * height <= high), None)
