"""Shapes are checked by beartype; dtypes and ranks are never promoted silently."""

import os
import pathlib

import hypothesis
import jaxtyping
import pytest

jaxtyping.install_import_hook("physxnet_jax", "beartype.beartype")

# The same examples in every run; others are looked for by --hypothesis-profile=default.
hypothesis.settings.register_profile("seeded", derandomize=True, database=None, deadline=None)
hypothesis.settings.load_profile("seeded")

import jax  # noqa: E402

jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")
from physxnet_jax._environment import free_programs, programs_folder  # noqa: E402

# Many tests compile the same programs, in several processes, and every run does again:
# once is enough on a machine.
_CACHE = programs_folder("tests")
_MOST_BYTES = 1e9
jax.config.update("jax_compilation_cache_dir", str(_CACHE))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
# For what tests start as processes of their own.
os.environ["JAX_COMPILATION_CACHE_DIR"] = str(_CACHE)
os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"


def pytest_configure(config):
    """Drops the oldest programs, in one process."""
    if hasattr(config, "workerinput") or not _CACHE.is_dir():
        return
    told = {p: p.stat() for p in _CACHE.iterdir()}
    size = sum(s.st_size for s in told.values())
    for path in sorted(told, key=lambda p: told[p].st_mtime):
        if size < _MOST_BYTES:
            break
        path.unlink(missing_ok=True)
        size -= told[path].st_size


@pytest.fixture(autouse=True, scope="module")
def _free_compiled_code():
    """Each compiled function holds memory maps, of which a process has 65,530."""
    yield
    free_programs(0.45)


@pytest.fixture(scope="session")
def data_dir() -> pathlib.Path:
    """The folder of real motion and garments; skips where there is none."""
    default = pathlib.Path(__file__).parents[2] / "shared"
    path = pathlib.Path(os.environ.get("PHYSXNET_DATA", default))
    if not (path / "mocap" / "ACTIONS.csv").is_file():
        pytest.skip(f"no motion data at {path}: set PHYSXNET_DATA")
    return path


@pytest.fixture(scope="session")
def body():
    from physxnet_jax.body import load_body

    return load_body()


@pytest.fixture(scope="session")
def rest(body):
    return body.rest_vertices(body.default_shape())
