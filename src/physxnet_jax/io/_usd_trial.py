"""A binary USD stage is first read by a process that may fail.

Its library believes what a file says of its own lengths: a damaged kilobyte takes
gigabytes, or the process down.
"""

import pathlib
import subprocess
import sys

from ..errors import FormatError

# What a reader takes beside the file, and for each byte of it [bytes].
_BASE, _PER_BYTE = 1_500_000_000, 20
# What it may take [s], and for each byte.
_SECONDS, _SECONDS_PER_BYTE = 20.0, 1e-6

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


def try_stage(path: pathlib.Path) -> None:
    """Reads a stage in a process of its own with bounded memory and time.

    Text that refers to no other file is left to the reader, which stops where it ends.

    Where no Python can be started (embedded, or forbidden) nothing is tried.

    Raises:
        FormatError: It takes too long for its size.
        ValueError: It can't be read in as much memory, or at all.
    """
    if not pathlib.Path(sys.executable or "").name.startswith("python"):
        return
    with path.open("rb") as file:
        if file.read(5) == b"#usda" and b"@" not in file.read():
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
