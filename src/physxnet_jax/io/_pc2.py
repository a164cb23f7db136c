"""PC2 point caches, with an OBJ of the first frame beside each."""

import pathlib
import struct

import numpy as np
from jaxtyping import Float

from ..errors import FormatError
from ..files import whole_file

_HEADER = struct.Struct("<12siiffi")


def write_pc2(path: str | pathlib.Path, positions: Float[np.ndarray, "frames vertices 3"]) -> None:
    """Writes a cache of positions [m], one sample a frame from frame 0, atomically."""
    frames, vertices, _ = positions.shape
    with whole_file(path) as part, part.open("wb") as file:
        file.write(_HEADER.pack(b"POINTCACHE2\0", 1, vertices, 0.0, 1.0, frames))
        file.write(np.ascontiguousarray(positions, dtype="<f4").tobytes())


def read_pc2(path: str | pathlib.Path) -> Float[np.ndarray, "frames vertices 3"]:
    """Positions of a PC2 cache.

    Raises:
        FormatError: Not a PC2, shorter than its header says, or without a sample for
            every frame.
    """
    blob = pathlib.Path(path).read_bytes()
    if len(blob) < _HEADER.size or not blob.startswith(b"POINTCACHE2\0"):
        raise FormatError(f"{path}: not a PC2 cache. Export it again as PC2.")
    _, _, vertices, _, step, frames = _HEADER.unpack_from(blob)
    if vertices < 1 or frames < 1 or len(blob) != _HEADER.size + 12 * vertices * frames:
        raise FormatError(
            f"{path}: {len(blob)} bytes, but the header announces {frames} frames of"
            f" {vertices} points. It is truncated: write it again."
        )
    if not (np.isfinite(step) and abs(step - 1.0) < 1e-3):
        raise FormatError(
            f"{path}: a sample every {step:g} frames. Export it with a sample for each frame."
        )
    data = np.frombuffer(blob, "<f4", offset=_HEADER.size)
    return data.reshape(frames, vertices, 3).astype(np.float32)
