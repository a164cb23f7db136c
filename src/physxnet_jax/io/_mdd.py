"""MDD point caches, which Maya, Houdini, Blender and LightWave read."""

import pathlib
import struct

import numpy as np
from jaxtyping import Float

from ..errors import FormatError
from ..files import atomic_write
from ..frames import in_chunks

_HEADER = struct.Struct(">ii")


def write_mdd(
    path: str | pathlib.Path, positions: Float[np.ndarray, "frames vertices 3"], fps: float
) -> None:
    """Writes a cache of positions [m], atomically; frame 0 is at time 0.

    References:
        NewTek's LightWave SDK: big-endian counts, times [s], then positions by frame.
    """
    frames, vertices, _ = positions.shape
    with atomic_write(path) as part, part.open("wb") as file:
        file.write(_HEADER.pack(frames, vertices))
        file.write((np.arange(frames) / fps).astype(">f4").tobytes())
        for x in in_chunks(positions):
            file.write(np.ascontiguousarray(x, dtype=">f4").data)


def read_mdd(
    path: str | pathlib.Path,
) -> tuple[Float[np.ndarray, "frames vertices 3"], Float[np.ndarray, " frames"]]:
    """Reads the positions [m] and times [s] of an MDD cache.

    Raises:
        FormatError: The file's length doesn't match its header.
    """
    blob = pathlib.Path(path).read_bytes()
    if len(blob) < _HEADER.size:
        raise FormatError(f"{path}: {len(blob)} bytes are too short for an MDD cache.")
    frames, vertices = _HEADER.unpack_from(blob)
    if frames < 1 or vertices < 1 or len(blob) != _HEADER.size + 4 * frames * (1 + 3 * vertices):
        raise FormatError(
            f"{path}: {len(blob)} bytes, but an MDD header would declare {frames} frames of"
            f" {vertices} points. It is truncated, or not MDD."
        )
    data = np.frombuffer(blob, ">f4", offset=_HEADER.size).astype(np.float32)
    return data[frames:].reshape(frames, vertices, 3), data[:frames]
