"""What times were measured on."""

import os
import platform
from typing import Any

import jax


def machine() -> dict[str, Any]:
    """Processor, cores, device and version, as they stand in result files."""
    return {
        "cpu": platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "device": jax.devices()[0].device_kind,
        "jax": jax.__version__,
    }
