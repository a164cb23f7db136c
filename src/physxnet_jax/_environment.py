"""Checks of the installed jaxlib, cache folders and JAX's compilation cache."""

import contextlib
import ctypes
import gc
import hashlib
import importlib.metadata
import os
import pathlib
import platform
import sys
from collections.abc import Mapping, MutableMapping, Sequence

from .errors import BrokenInstallError

BROKEN_JAXLIB = {
    "0.10.2": "computes wrong numbers on CPU (jax-ml/jax#39103)",
    "0.11.0": "is suspected of the same fault (jax-ml/jax#39257)",
}
_MAPS_ALLOWED = pathlib.Path("/proc/sys/vm/max_map_count")
_MAPS_HELD = pathlib.Path("/proc/self/maps")
_FEW_PARTS = {"xla_cpu_use_fusion_emitters": False, "xla_cpu_parallel_codegen_split_count": 2}
_TRIED = ("0.10.1",)
_BRIEF = {"dress", "demo", "inspect", "fit", "tailor", "export", "export-rest"}
# Of glibc's malloc.h.
_M_ARENA_MAX = -8
_FLAG = "xla_cpu_experimental_ynn_fusion_type="


def jaxlib_problem(version: str, flags: str = "") -> str | None:
    """Returns why a jaxlib version can't be used, or None if it can.

    Args:
        version: Version of jaxlib.
        flags: ``XLA_FLAGS``; disabling the faulty fusion there avoids the fault.
    """
    words = flags.split()
    if version not in BROKEN_JAXLIB or any(w.endswith(_FLAG) for w in words):
        return None
    return (
        f"jaxlib {version} {BROKEN_JAXLIB[version]}. Install another:"
        " pip install 'jax>=0.10.1,!=0.10.2,!=0.11.0'."
    )


def check_jaxlib() -> None:
    """Raises an error if the installed jaxlib is known to compute wrong results.

    Raises:
        BrokenInstallError: The message names a version to install.
    """
    problem = jaxlib_problem(importlib.metadata.version("jaxlib"), os.environ.get("XLA_FLAGS", ""))
    if problem is not None:
        raise BrokenInstallError(problem)


def cache_folder() -> pathlib.Path:
    """Folder of this machine's timings and programs, in $XDG_CACHE_HOME or ~/.cache."""
    home = os.environ.get("XDG_CACHE_HOME") or pathlib.Path.home() / ".cache"
    return pathlib.Path(home) / "physxnet_jax"


def compilation_cache_folder(what: str = "programs") -> pathlib.Path:
    """Folder of compiled programs for this type of processor.

    Machines that share a home folder can't always run each other's programs.
    """
    machine = f"{platform.machine()}-{hashlib.sha256(_processor().encode()).hexdigest()[:8]}"
    return cache_folder() / what / machine


def uses_compilation_cache(words: Sequence[str]) -> bool:
    """Whether a command line is a `physxnet` command that should cache its programs.

    Commands that measure compilation must compile.
    """
    return is_command(words) and words[1:2] not in (["bench"], ["effects"])


def uses_few_parts(words: Sequence[str]) -> bool:
    """Whether a command line is a `physxnet` command that compiles for longer than it computes.

    What is compiled in few parts runs for longer: nothing for commands that simulate, train, show
    cloth live, or measure times.
    """
    brief = is_command(words) and not _BRIEF.isdisjoint(words[1:2])
    return brief and not any(w.rpartition("=")[2] == "simulate" for w in words)


def is_command(words: Sequence[str]) -> bool:
    """Whether a command line runs `physxnet`."""
    return bool(words) and pathlib.PurePath(words[0]).stem == "physxnet"


def enable_compilation_cache(environment: MutableMapping[str, str] | None = None) -> None:
    """Enables JAX's persistent compilation cache; call it before jax is imported.

    Variables that are already set keep their values.

    Args:
        environment: Environment variables to set; those of this process by default.
    """
    env = os.environ if environment is None else environment
    env.setdefault("JAX_COMPILATION_CACHE_DIR", str(compilation_cache_folder()))
    # Cache small programs too: there are a hundred, which together take seconds.
    env.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
    # On loading from the cache, XLA mistakes its own hints for missing instructions and
    # logs an error (jax-ml/jax#38445).
    env.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")


def clear_caches_if_full(share: float = 0.6) -> bool:
    """Clears JAX's caches before the process runs out of memory maps.

    Every compiled function holds some memory maps. When none are left, the compiler aborts
    the process, however much memory is free. Systems other than Linux have no such limit;
    there the function does nothing.

    Args:
        share: Fraction of the allowed maps at which the caches are cleared.

    Returns:
        Whether the caches were cleared.
    """
    try:
        limit = int(_MAPS_ALLOWED.read_text())
        with _MAPS_HELD.open("rb") as lines:
            used = sum(1 for _ in lines)
    except (OSError, ValueError):
        return False
    if used < share * limit:
        return False
    import jax

    jax.clear_caches()
    return True


def release_programs() -> None:
    """Gives up the memory of compiled programs, if this process is a `physxnet` command.

    Programs that prepared garments are needed once, and hold hundreds of megabytes. One that is
    needed again is loaded from the compilation cache.
    """
    if not is_command(sys.argv):
        return
    import jax

    jax.clear_caches()
    gc.collect()
    # The allocator of glibc keeps what was freed.
    with contextlib.suppress(OSError, AttributeError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)


def compile_whole_programs(
    environment: MutableMapping[str, str] | None = None, version: str | None = None
) -> None:
    """Makes XLA compile a program in few parts on processors; call it before jax is imported.

    By default each fused loop is a library of its own: programs of hundreds of loops then take
    longer to compile, and more memory.

    Args:
        environment: Environment variables to change; those of this process by default. Flags that
            are already in ``XLA_FLAGS`` keep their values.
        version: Version of jaxlib. XLA ends the process at a flag that it doesn't know: nothing
            is changed for versions on which this wasn't tried.
    """
    env = os.environ if environment is None else environment
    parts = few_parts(env, version)
    flags = [f"--{name}={str(value).lower()}" for name, value in (parts or {}).items()]
    if flags:
        env["XLA_FLAGS"] = " ".join([*env.get("XLA_FLAGS", "").split(), *flags])


def few_parts(
    environment: Mapping[str, str] | None = None, version: str | None = None
) -> dict[str, bool | int] | None:
    """Options of `jax.jit` as of `compile_whole_programs`; None if there are none to set."""
    env = os.environ if environment is None else environment
    version = importlib.metadata.version("jaxlib") if version is None else version
    known = {f.partition("=")[0] for f in env.get("XLA_FLAGS", "").split()}
    parts = {k: v for k, v in _FEW_PARTS.items() if f"--{k}" not in known}
    return parts or None if version in _TRIED else None


def share_one_heap() -> None:
    """Makes all threads allocate from one heap; call it before they are started.

    The allocator of glibc keeps a heap for each of many threads, and what one of them has freed is
    of no use to the others. Other allocators have no such setting.
    """
    with contextlib.suppress(OSError, AttributeError, TypeError):
        ctypes.CDLL(None).mallopt(_M_ARENA_MAX, 1)


def processor_name() -> str:
    """Name of the processor, as far as the system reports it."""
    return _processor("model name", "CPU part")


def _processor(*keys: str) -> str:
    try:
        lines = pathlib.Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    keys = keys or ("flags", "Features")
    return next((" ".join(x.split()) for x in lines if x.startswith(keys)), platform.processor())
