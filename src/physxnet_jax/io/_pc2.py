"""PC2 point caches, with an OBJ of the first frame beside each."""

import pathlib
import struct

import numpy as np
from jaxtyping import Float

from ..errors import FormatError
from ..files import atomic_write
from ..frames import in_chunks

_HEADER = struct.Struct("<12siiffi")


def write_pc2(path: str | pathlib.Path, positions: Float[np.ndarray, "frames vertices 3"]) -> None:
    """Writes a cache of positions [m], one sample per frame from frame 0, atomically."""
    frames, vertices, _ = positions.shape
    with atomic_write(path) as part, part.open("wb") as file:
        file.write(_HEADER.pack(b"POINTCACHE2\0", 1, vertices, 0.0, 1.0, frames))
        for x in in_chunks(positions):
            file.write(np.ascontiguousarray(x, dtype="<f4").data)


def read_pc2(path: str | pathlib.Path) -> Float[np.ndarray, "frames vertices 3"]:
    """Reads the positions of a PC2 cache.

    Raises:
        FormatError: The file isn't PC2, its length doesn't match its header, or it hasn't
            one sample per frame.
    """
    blob = pathlib.Path(path).read_bytes()
    if len(blob) < _HEADER.size or not blob.startswith(b"POINTCACHE2\0"):
        raise FormatError(f"{path}: not a PC2 cache. Export it again as PC2.")
    _, _, vertices, _, step, frames = _HEADER.unpack_from(blob)
    if vertices < 1 or frames < 1 or len(blob) != _HEADER.size + 12 * vertices * frames:
        raise FormatError(
            f"{path}: {len(blob)} bytes, but the header declares {frames} frames of"
            f" {vertices} points. It is truncated: write it again."
        )
    if not (np.isfinite(step) and abs(step - 1.0) < 1e-3):
        raise FormatError(
            f"{path}: a sample every {step:g} frames. Export it with a sample for each frame."
        )
    data = np.frombuffer(blob, "<f4", offset=_HEADER.size)
    return data.reshape(frames, vertices, 3).astype(np.float32)
