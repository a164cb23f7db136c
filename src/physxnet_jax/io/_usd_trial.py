"""Trial reading of a USD stage in a subprocess that may fail.

usd-core trusts the lengths in a binary file: a damaged kilobyte can take gigabytes of memory or
crash the process. So can text that is nested without end or refers to itself.
"""

import pathlib
import re
import subprocess
import sys

import numpy as np

from ..errors import FormatError

# Memory limit of the subprocess: a constant, and a share per byte of the file [bytes].
_BASE, _PER_BYTE = 1_500_000_000, 20
# Time limit of the subprocess: a constant, and a share per byte of the file [s].
_SECONDS, _SECONDS_PER_BYTE = 20.0, 1e-6

# Syntax that composes a stage from others, or repeatedly from itself.
_COMPOSITION = re.compile(rb"@|\b(references|inherits|specializes|payload|variantSets?)\b")
# Deepest nesting of brackets in a stage of plain meshes.
_MAX_DEPTH = 100
# Bytes to scan at a time.
_PIECE = 1 << 20

# Reads every attribute once at all its times.
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
    """Deepest nesting of brackets, including those in quotes."""
    step = np.zeros(256, np.int8)
    step[list(b"{[(")], step[list(b"}])")] = 1, -1
    depth = deepest = 0
    for at in range(0, len(text), _PIECE):
        chunk = np.frombuffer(text, np.uint8, min(_PIECE, len(text) - at), at)
        depths = depth + np.cumsum(step[chunk], dtype=np.int64)
        depth, deepest = int(depths[-1]), max(deepest, int(depths.max()))
    return deepest


def try_stage(path: pathlib.Path) -> None:
    """Reads a stage in a subprocess with bounded memory and time.

    Plain text that is flat and has no references isn't tried, because reading it is bounded by
    its length. Nothing is tried where no Python can be started (embedded, or forbidden).

    Raises:
        FormatError: Reading takes too long for the file's size.
        ValueError: The stage can't be read within the memory limit, or at all.
    """
    if not pathlib.Path(sys.executable or "").name.startswith("python"):
        return
    text = path.read_bytes()
    if text.startswith(b"#usda") and not _COMPOSITION.search(text) and _depth(text) <= _MAX_DEPTH:
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
            f"{path}: reading takes too much time for its size. Export it again."
        ) from None
    except OSError:
        return
    if done.returncode:
        raise ValueError(f"{path}: damaged.")
