"""`physxnet doctor`: the first thing a bug report asks for."""

import importlib.metadata
import os
import platform
import sys

from rich.console import Console
from rich.table import Table

from .._environment import jaxlib_problem
from .._version import __version__

_REQUIRED = ("jax", "jaxlib", "flax", "optax", "orbax-checkpoint", "numpy", "scipy", "trimesh")
_OPTIONAL = {
    "usd-core": "usd: writes .usdc",
    "pygltflib": "gltf: writes .glb and .html",
    "fast-simplification": "mesh: decimates garments",
    "pyvista": "render: pictures and videos",
    "imageio-ffmpeg": "render: .mp4",
    "viser": "viewer: in the browser",
}


def doctor(console: Console) -> int:
    """Prints versions, devices and optional parts; 1 if jaxlib can't be trusted."""
    table = Table(title=f"physxnet_jax {__version__}", title_justify="left")
    table.add_column("part")
    table.add_column("found")
    table.add_row("python", f"{platform.python_version()} ({sys.platform}, {platform.machine()})")
    for name in _REQUIRED:
        table.add_row(name, _version(name) or "[red]missing[/red]")
    for name, use in _OPTIONAL.items():
        table.add_row(name, _version(name) or f"not installed (extra {use})")
    problem = jaxlib_problem(_version("jaxlib") or "", os.environ.get("XLA_FLAGS", ""))
    if problem is None:
        import jax

        for device in jax.devices():
            table.add_row("device", f"{device.platform}: {device.device_kind}")
        from ..io import list_weights

        table.add_row("weights", ", ".join(list_weights()) or "none")
    console.print(table)
    if problem is not None:
        console.print(f"[red]{problem}[/red]")
        return 1
    console.print("jaxlib: no known fault in this version.")
    return 0


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None
