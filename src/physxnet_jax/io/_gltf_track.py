"""Interpolates the tracks of glTF animations between their keys."""

import numpy as np
from jaxtyping import Float

from ..geometry import slerp


def track_at(
    times: Float[np.ndarray, " keys"],
    values: Float[np.ndarray, "rows n"],
    mode: str,
    at: Float[np.ndarray, " frames"],
    kind: str,
) -> Float[np.ndarray, "frames n"]:
    """Evaluates a track at given times."""
    # A key that is later than `at` by a rounding error counts as reached.
    low = np.clip(np.searchsorted(times, at + 1e-6, side="right") - 1, 0, len(times) - 1)
    high = np.minimum(low + 1, len(times) - 1)
    span = np.maximum(times[high] - times[low], 1e-9)
    t = np.clip((at - times[low]) / span, 0.0, 1.0)[:, None]
    if mode == "STEP":
        out = values[low]
    elif mode == "CUBICSPLINE":
        keys = values.reshape(len(times), 3, -1)
        d = span[:, None]
        a, b = keys[low, 1], keys[high, 1]
        va, vb = d * keys[low, 2], d * keys[high, 0]
        out = (
            (2 * t**3 - 3 * t**2 + 1) * a
            + (t**3 - 2 * t**2 + t) * va
            + (3 * t**2 - 2 * t**3) * b
            + (t**3 - t**2) * vb
        )
    elif kind == "rotation":
        out = _slerp(values[low], values[high], t)
    else:
        out = values[low] + t * (values[high] - values[low])
    if kind == "rotation":
        length = np.linalg.norm(out, axis=1, keepdims=True)
        out = np.where(length > 1e-9, out / np.maximum(length, 1e-9), (0.0, 0.0, 0.0, 1.0))
    return out


def _slerp(
    a: Float[np.ndarray, "n 4"], b: Float[np.ndarray, "n 4"], t: Float[np.ndarray, "n 1"]
) -> Float[np.ndarray, "n 4"]:
    return slerp(_unit(a), _unit(b), t)


def _unit(q: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, "n 4"]:
    """Normalises quaternions; zeros become the identity."""
    length = np.linalg.norm(q, axis=1, keepdims=True)
    ok = (length > 1e-9) & np.isfinite(length)
    return np.where(ok, q / np.where(ok, length, 1.0), (0.0, 0.0, 0.0, 1.0))
