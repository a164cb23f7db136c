"""A USD stage is first read by a process that may fail.

Its library believes what a binary file says of its own lengths: a damaged kilobyte takes
gigabytes, or the process down. So does text that is nested without end or refers to itself.
"""

import pathlib
import re
import subprocess
import sys

import numpy as np

from ..errors import FormatError

# What a reader takes beside the file, and for each byte of it [bytes].
_BASE, _PER_BYTE = 1_500_000_000, 20
# What it may take [s], and for each byte.
_SECONDS, _SECONDS_PER_BYTE = 20.0, 1e-6

# What composes a stage of others, or of itself several times over.
_REFERS = re.compile(rb"@|\b(references|inherits|specializes|payload|variantSets?)\b")
# Brackets within brackets that a stage of plain meshes has at most.
_DEEPEST = 100
# Bytes looked at in one go.
_PIECE = 1 << 20

# Everything that could be asked for is read once.
_TRIAL = """
import sys
try:
    import resource
    resource.setrlimit(resource.RLIMIT_AS, (int(sys.argv[2]),) * 2)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
except (ImportError, ValueError, OSError):
    pass
from pxr import Usd
stage = Usd.Stage.Open(sys.argv[1])
for prim in Usd.PrimRange(stage.GetPseudoRoot(), Usd.TraverseInstanceProxies()):
    for attribute in prim.GetAttributes():
        for when in [Usd.TimeCode.Default(), *attribute.GetTimeSamples()]:
            attribute.Get(when)
"""


def _depth(text: bytes) -> int:
    """How deep brackets lie within each other, those in quotes counted too."""
    step = np.zeros(256, np.int8)
    step[list(b"{[(")], step[list(b"}])")] = 1, -1
    depth = most = 0
    for at in range(0, len(text), _PIECE):
        piece = np.frombuffer(text, np.uint8, min(_PIECE, len(text) - at), at)
        depths = depth + np.cumsum(step[piece], dtype=np.int64)
        depth, most = int(depths[-1]), max(most, int(depths.max()))
    return most


def try_stage(path: pathlib.Path) -> None:
    """Reads a stage in a process of its own with bounded memory and time.

    Plain text, flat and without references, is left to the reader, which stops where it ends.

    Where no Python can be started (embedded, or forbidden) nothing is tried.

    Raises:
        FormatError: It takes too long for its size.
        ValueError: It can't be read in as much memory, or at all.
    """
    if not pathlib.Path(sys.executable or "").name.startswith("python"):
        return
    text = path.read_bytes()
    if text.startswith(b"#usda") and not _REFERS.search(text) and _depth(text) <= _DEEPEST:
        return
    beside = {path, *path.parent.glob("*.usd*"), *path.parent.glob("*/*.usd*")}
    size = sum(p.stat().st_size for p in beside if p.is_file())
    words = [sys.executable, "-P", "-c", _TRIAL, str(path), str(_BASE + _PER_BYTE * size)]
    try:
        done = subprocess.run(
            words,
            capture_output=True,
            timeout=_SECONDS + _SECONDS_PER_BYTE * size,
            stdin=subprocess.DEVNULL,
        )
    except subprocess.TimeoutExpired:
        raise FormatError(
            f"{path}: its size doesn't account for the time it takes to read. Export it again."
        ) from None
    except OSError:
        return
    if done.returncode:
        raise ValueError(f"{path}: damaged.")
