"""Identifies the machine that times are measured on."""

import os
import platform
from typing import Any

import jax

from .._environment import processor_name


def machine() -> dict[str, Any]:
    """Processor, cores, device and JAX version, as recorded in result files."""
    return {
        "cpu": processor_name(),
        "cores": os.cpu_count(),
        "device": jax.devices()[0].device_kind,
        "jax": jax.__version__,
    }


def same_machine(recorded: dict[str, Any]) -> bool:
    """Whether a row's machine is this one; older rows record only the architecture."""
    here = machine()
    known = (here["cpu"], platform.machine())
    return recorded.get("cpu") in known and {**recorded, "cpu": here["cpu"]} == here
