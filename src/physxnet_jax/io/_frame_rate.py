"""Recovers frame rates that files round."""

_BROADCAST = tuple(k * 1000.0 / 1001.0 for k in (24, 30, 48, 60, 120))


def nominal_rate(fps: float) -> float:
    """Snaps a rounded frame rate [1/s] to the nearest integer or broadcast rate.

    Example:
        >>> nominal_rate(1 / 0.0083333), nominal_rate(1 / 0.0333)
        (120.0, 30.0)
        >>> round(nominal_rate(29.97), 5)
        29.97003
    """
    nearest = min((float(round(fps)), *_BROADCAST), key=lambda r: abs(r - fps))
    return nearest if nearest > 0 and abs(nearest - fps) < 0.05 else fps
