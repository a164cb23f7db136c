"""What times were measured on."""

import os
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
