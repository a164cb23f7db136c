"""What is installed, and whether it can be trusted with numbers."""

import importlib.metadata
import os

from .errors import BrokenInstallError

BROKEN_JAXLIB = {
    "0.10.2": "computes wrong numbers on CPU (jax-ml/jax#39103)",
    "0.11.0": "is suspected of the same fault (jax-ml/jax#39257)",
}
_FLAG = "xla_cpu_experimental_ynn_fusion_type="


def jaxlib_problem(version: str, flags: str = "") -> str | None:
    """Why a jaxlib can't be used, or None.

    Args:
        version: Version of jaxlib.
        flags: ``XLA_FLAGS``; the fault is off if its fusion is switched off there.
    """
    words = flags.split()
    if version not in BROKEN_JAXLIB or any(w.endswith(_FLAG) for w in words):
        return None
    return (
        f"jaxlib {version} {BROKEN_JAXLIB[version]}. Install another:"
        " pip install 'jax>=0.10.1,!=0.10.2,!=0.11.0'."
    )


def check_jaxlib() -> None:
    """Refuses a jaxlib known to compute wrong numbers.

    Raises:
        BrokenInstallError: The text names a version to install.
    """
    problem = jaxlib_problem(importlib.metadata.version("jaxlib"), os.environ.get("XLA_FLAGS", ""))
    if problem is not None:
        raise BrokenInstallError(problem)
