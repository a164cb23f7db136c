"""Padding of arrays, so that meshes of similar size share compiled programs."""

import numpy as np
from jaxtyping import Shaped

_MULTIPLE = 1024


def padded_rows(values: Shaped[np.ndarray, "rows ..."]) -> Shaped[np.ndarray, "padded ..."]:
    """Repeats the last row of an array up to a multiple of 1024 rows.

    Programs are compiled for a number of rows; meshes of about the same size then share
    one. Empty arrays stay empty.

    Args:
        values: Any array, shape [rows, ...].

    Example:
        >>> padded_rows(np.zeros((3, 2))).shape
        (1024, 2)
    """
    more = -len(values) % _MULTIPLE
    return np.concatenate([values, np.repeat(values[-1:], more, axis=0)])
