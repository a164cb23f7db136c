"""Reads arrays from pickled dictionaries without running code that they may contain."""

import pathlib
import pickle

import numpy as np

_MAX_BYTES = 300_000_000
# What a pickle of a dictionary of numeric arrays needs, under NumPy's names of both versions.
_ALLOWED = {
    ("numpy", "ndarray"),
    ("numpy", "dtype"),
    ("_codecs", "encode"),
    *((f"numpy.{core}.multiarray", "_reconstruct") for core in ("core", "_core")),
    *((f"numpy.{core}.multiarray", "scalar") for core in ("core", "_core")),
    *((f"numpy.{core}.numeric", "_frombuffer") for core in ("core", "_core")),
}


class _ArraysOnly(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> object:
        if (module, name) not in _ALLOWED:
            raise ValueError(f"it needs {module}.{name}, which isn't loaded from files")
        module = module.replace("numpy.core", "numpy._core")
        return super().find_class(module, name)


def read_pickled_arrays(path: pathlib.Path, names: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Numeric arrays and numbers of a pickled dictionary.

    Args:
        path: The file.
        names: Keys to return, if present.

    Raises:
        ValueError: Anything but a dictionary of arrays and plain values.
        OSError: The file can't be read.
    """
    if path.stat().st_size > _MAX_BYTES:
        raise ValueError("over 300 MB")
    with path.open("rb") as file:
        try:
            found = _ArraysOnly(file, encoding="latin1").load()
        except OSError:
            raise
        # Damaged pickles raise many exception types.
        except Exception as error:
            raise ValueError(f"{type(error).__name__}: {error}"[:200]) from error
    if not isinstance(found, dict):
        raise ValueError(f"it holds a {type(found).__name__}, not a dictionary")
    arrays = {k: np.asarray(found[k]) for k in names if k in found}
    bad = [k for k, v in arrays.items() if v.dtype.hasobject]
    if bad:
        raise ValueError(f"'{bad[0]}' isn't an array of numbers")
    return arrays
