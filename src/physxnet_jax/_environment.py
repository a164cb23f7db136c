"""What is installed, whether it can be trusted with numbers, and where programs are kept."""

import hashlib
import importlib.metadata
import os
import pathlib
import platform
from collections.abc import MutableMapping, Sequence

from .errors import BrokenInstallError

BROKEN_JAXLIB = {
    "0.10.2": "computes wrong numbers on CPU (jax-ml/jax#39103)",
    "0.11.0": "is suspected of the same fault (jax-ml/jax#39257)",
}
_MAPS_ALLOWED = pathlib.Path("/proc/sys/vm/max_map_count")
_MAPS_HELD = pathlib.Path("/proc/self/maps")
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


def cache_folder() -> pathlib.Path:
    """Where this machine's times and programs are kept: $XDG_CACHE_HOME or ~/.cache."""
    home = os.environ.get("XDG_CACHE_HOME") or pathlib.Path.home() / ".cache"
    return pathlib.Path(home) / "physxnet_jax"


def programs_folder(what: str = "programs") -> pathlib.Path:
    """Where compiled programs are kept, for this kind of processor alone.

    A home may be shared by machines of which one can't run what another has compiled.
    """
    machine = f"{platform.machine()}-{hashlib.sha256(_processor().encode()).hexdigest()[:8]}"
    return cache_folder() / what / machine


def keeps_programs(words: Sequence[str]) -> bool:
    """Whether a process of these words is a command that should keep its programs.

    Commands that measure compilation must compile.
    """
    return is_command(words) and words[1:2] not in (["bench"], ["effects"])


def is_command(words: Sequence[str]) -> bool:
    """Whether a process of these words is the command `physxnet`."""
    return bool(words) and pathlib.PurePath(words[0]).stem == "physxnet"


def keep_programs(environment: MutableMapping[str, str] | None = None) -> None:
    """Lets JAX keep compiled programs for the next process; before jax is imported.

    What is already set stays as it is.

    Args:
        environment: Variables to set; the process's own by default.
    """
    env = os.environ if environment is None else environment
    env.setdefault("JAX_COMPILATION_CACHE_DIR", str(programs_folder()))
    # The small ones as well: there are a hundred, and together they take seconds.
    env.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
    # Loading from the cache, XLA takes its own hints for missing instructions and says so
    # as an error (jax-ml/jax#38445).
    env.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")


def free_programs(share: float = 0.6) -> bool:
    """Forgets what was compiled before it takes all memory maps that a process may have.

    Every compiled function holds some; where there are none left the compiler ends the
    process, however much memory is free. Where maps aren't bounded (all systems but Linux)
    nothing is done.

    Args:
        share: Of all maps, from which on programs are forgotten.

    Returns:
        Whether they were.
    """
    try:
        most = int(_MAPS_ALLOWED.read_text())
        with _MAPS_HELD.open("rb") as lines:
            held = sum(1 for _ in lines)
    except (OSError, ValueError):
        return False
    if held < share * most:
        return False
    import jax

    jax.clear_caches()
    return True


def processor_name() -> str:
    """What the processor is called, as far as the system says it."""
    return _processor("model name", "CPU part")


def _processor(*keys: str) -> str:
    try:
        lines = pathlib.Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    keys = keys or ("flags", "Features")
    return next((" ".join(x.split()) for x in lines if x.startswith(keys)), platform.processor())
