"""What times were measured on."""

import os
import platform
from typing import Any

import jax

from .._environment import processor_name


def machine() -> dict[str, Any]:
    """Processor, cores, device and version, as they stand in result files."""
    return {
        "cpu": processor_name(),
        "cores": os.cpu_count(),
        "device": jax.devices()[0].device_kind,
        "jax": jax.__version__,
    }


def same_machine(there: dict[str, Any]) -> bool:
    """Whether this one is noted, as far as is told: the processor's name wasn't always."""
    here = machine()
    known = (here["cpu"], platform.machine())
    return there.get("cpu") in known and {**there, "cpu": here["cpu"]} == here
