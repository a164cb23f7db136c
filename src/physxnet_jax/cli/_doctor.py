"""`physxnet doctor`: versions and devices, for bug reports."""

import importlib.metadata
import os
import platform
import sys

from rich.console import Console
from rich.table import Table
from rich.text import Text

from .._environment import jaxlib_problem
from .._version import __version__
from ._commands import Doctor
from ._progress import print_json

_REQUIRED = ("jax", "jaxlib", "flax", "optax", "orbax-checkpoint", "numpy", "scipy", "trimesh")
_OPTIONAL = {
    "usd-core": "usd: writes .usdc",
    "pygltflib": "gltf: writes .glb and .html",
    "fast-simplification": "mesh: decimates garments",
    "pyvista": "render: images and videos",
    "imageio-ffmpeg": "render: .mp4",
    "viser": "viewer: in the browser",
}


_MISSING = "missing"


def doctor(command: Doctor, console: Console) -> int:
    """Prints versions, devices and optional packages; returns 1 if it finds a problem."""
    rows = [("python", f"{platform.python_version()} ({sys.platform}, {platform.machine()})")]
    rows += [(name, _version(name) or _MISSING) for name in _REQUIRED]
    rows += [(n, _version(n) or f"not installed (extra {use})") for n, use in _OPTIONAL.items()]
    problem = jaxlib_problem(_version("jaxlib") or "", os.environ.get("XLA_FLAGS", ""))
    missing = [name for name in _REQUIRED if _version(name) is None]
    if missing:
        problem = f"{', '.join(missing)} missing. Install: pip install {' '.join(missing)}."
    if problem is None:
        import jax

        for device in jax.devices():
            rows.append(("device", f"{device.platform}: {device.device_kind}"))
        from ..models import list_weights

        rows.append(("weights", ", ".join(list_weights()) or "none"))
    if command.terminal.json:
        print_json({"version": __version__, "parts": dict(rows), "problem": problem})
        return int(problem is not None)
    table = Table(title=f"physxnet_jax {__version__}", title_justify="left")
    table.add_column("part")
    table.add_column("found")
    for name, found in rows:
        table.add_row(name, Text(found, style="red" if found == _MISSING else ""))
    console.print(table)
    if problem is not None:
        console.print(problem, style="red")
        return 1
    console.print("jaxlib: no known fault in this version.")
    return 0


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None
