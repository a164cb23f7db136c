"""Padding of arrays, so that meshes of similar size share compiled programs."""

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Int, Shaped

ROW_MULTIPLE = 1024
"""`padded_rows` pads to multiples of it."""


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
    more = -len(values) % ROW_MULTIPLE
    return np.concatenate([values, np.repeat(values[-1:], more, axis=0)])


def pad_rows(
    rows: sp.csr_matrix,
) -> tuple[Int[np.ndarray, "rows k"], Float[np.ndarray, "rows k"]]:
    """Converts sparse rows to index and weight tables, padded with zero weights."""
    rows = sp.csr_matrix(rows)
    rows.sum_duplicates()
    indptr, indices, data = (np.asarray(x) for x in (rows.indptr, rows.indices, rows.data))
    count = np.diff(indptr)
    index = np.zeros((len(count), count.max()), dtype=np.int32)
    weight = np.zeros((len(count), count.max()), dtype=np.float32)
    for i in range(len(count)):
        part = slice(indptr[i], indptr[i + 1])
        index[i, : count[i]] = indices[part]
        weight[i, : count[i]] = data[part]
    return index, weight
