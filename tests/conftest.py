"""Shapes are checked by beartype; dtypes and ranks are never promoted silently."""

import csv
import ctypes
import dataclasses
import gc
import json
import os
import pathlib
import resource
import sys

import hypothesis
import jaxtyping
import numpy as np
import pytest

jaxtyping.install_import_hook("physxnet_jax", "beartype.beartype")

# The same examples in every run; others are looked for by --hypothesis-profile=default.
hypothesis.settings.register_profile("seeded", derandomize=True, database=None, deadline=None)
hypothesis.settings.load_profile("seeded")

import jax  # noqa: E402

jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")
from physxnet_jax._environment import clear_caches_if_full, compilation_cache_folder  # noqa: E402

# Many tests compile the same programs, in several processes, and every run does again:
# once is enough on a machine.
_CACHE = compilation_cache_folder("tests")
_MOST_BYTES = 1e9
jax.config.update("jax_compilation_cache_dir", str(_CACHE))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
# For what tests start as processes of their own.
os.environ["JAX_COMPILATION_CACHE_DIR"] = str(_CACHE)
os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"


def pytest_configure(config):
    """Drops the oldest programs, in one process."""
    config.pluginmanager.register(_Peaks(), "peaks")
    if hasattr(config, "workerinput") or not _CACHE.is_dir():
        return
    stats = {p: p.stat() for p in _CACHE.iterdir()}
    size = sum(s.st_size for s in stats.values())
    for path in sorted(stats, key=lambda p: stats[p].st_mtime):
        if size < _MOST_BYTES:
            break
        path.unlink(missing_ok=True)
        size -= stats[path].st_size


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Of a test marked ``sampled(n)``, n cases evenly spread stay; the others are nightly."""
    cases = {}
    for item in items:
        if item.get_closest_marker("sampled") and not item.get_closest_marker("nightly"):
            cases.setdefault(item.nodeid.partition("[")[0], []).append(item)
    for some in cases.values():
        (count,) = some[0].get_closest_marker("sampled").args
        kept = {k * len(some) // count for k in range(count)}
        for k, item in enumerate(some):
            if k not in kept:
                item.add_marker(pytest.mark.nightly)


# Two workers must fit a laptop; compiled programs are most of a worker's memory [bytes].
_MOST_MEMORY = 0.9e9


def _memory() -> float:
    """Resident memory of this process [bytes]; 0 where the system doesn't report it."""
    try:
        pages = int(pathlib.Path("/proc/self/statm").read_text().split()[1])
    except (OSError, ValueError):
        return 0.0
    return pages * os.sysconf("SC_PAGE_SIZE")


@pytest.fixture(autouse=True, scope="module")
def _free_compiled_code():
    """Each compiled function holds memory, and maps of which a process has 65,530."""
    yield
    if not clear_caches_if_full(0.45) and _memory() > _MOST_MEMORY:
        jax.clear_caches()
    gc.collect()
    if sys.platform == "linux":
        # The allocator keeps what is freed otherwise.
        ctypes.CDLL("libc.so.6").malloc_trim(0)


def pytest_sessionfinish(session):
    """Each worker reports its peak memory."""
    if hasattr(session.config, "workeroutput"):
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        session.config.workeroutput["peak_mb"] = peak / 1024


class _Peaks:
    """Peak memory of the workers, shown at the end."""

    def __init__(self):
        self.found = []

    @pytest.hookimpl(optionalhook=True)
    def pytest_testnodedown(self, node):
        self.found.append(getattr(node, "workeroutput", {}).get("peak_mb", 0.0))

    def pytest_terminal_summary(self, terminalreporter):
        if self.found:
            peaks = ", ".join(f"{x:.0f}" for x in self.found)
            terminalreporter.write_line(f"peak memory of the workers [MB]: {peaks}")


@pytest.fixture(scope="session")
def data_dir() -> pathlib.Path:
    """The folder of real motion and garments; skips where there is none."""
    default = pathlib.Path(__file__).parents[2] / "shared"
    path = pathlib.Path(os.environ.get("PHYSXNET_DATA", default))
    if not (path / "mocap" / "ACTIONS.csv").is_file():
        pytest.skip(f"no motion data at {path}: set PHYSXNET_DATA")
    return path


@pytest.fixture(scope="session")
def apart():
    """Distance of nine coordinates in ten of two arrays [m].

    Two programs round differently, which decides contacts and, of simulated cloth, folds.
    """

    def distance(x, y):
        return float(np.quantile(np.abs(np.asarray(x) - np.asarray(y)), 0.9))

    return distance


@pytest.fixture(scope="session")
def write_mocap():
    """Writes a folder of motion: a piece of the built-in punch, and the actions cut from it.

    Called with the folder, the number of frames, and rows of split, action, start and frames.
    """
    from physxnet_jax.motion import load_motion, save_motion

    def write(folder, count, actions):
        clip = load_motion("punch", fps=30.0)
        clip = dataclasses.replace(clip, rotations=clip.rotations[:count], root=clip.root[:count])
        save_motion(folder / "punch.npz", clip)
        with (folder / "ACTIONS.csv").open("w", newline="") as file:
            table = csv.writer(file)
            table.writerow(["split", "action", "file", "start_s", "frames_at_30fps"])
            for split, action, start, frames in actions:
                table.writerow([split, action, "punch.npz", start, frames])
        return folder

    return write


@pytest.fixture
def promise():
    """Records a measured figure of docs/reliability.md, where PHYSXNET_RECORD says to.

    Called with the promise, the case, the figure and its unit, and the tries and failures if more
    than one was made.
    """
    from physxnet_jax.files import claim, write_json

    def record(promise, case, figure, unit, *, tries=1, failures=0):
        folder = os.environ.get("PHYSXNET_RECORD")
        if folder is None:
            return
        path = pathlib.Path(folder) / "reliability.json"
        row = {
            **{"promise": promise, "case": case, "tries": tries, "failures": failures},
            **{"figure": float(f"{figure:.4g}"), "unit": unit},
        }
        with claim(path, wait=True):
            rows = json.loads(path.read_text()) if path.is_file() else []
            others = [r for r in rows if (r["promise"], r["case"]) != (promise, case)]
            write_json(path, sorted([*others, row], key=lambda r: (r["promise"], r["case"])))

    return record


@pytest.fixture(scope="session")
def body():
    from physxnet_jax.body import load_body

    return load_body()


@pytest.fixture(scope="session")
def rest(body):
    return body.rest_vertices(body.default_shape())
