"""What is kept between runs, and where."""

import os
import pathlib
import platform
import subprocess
import sys
import threading

import jax
import jax.numpy as jnp
import pytest

from physxnet_jax._environment import (
    cache_folder,
    clear_caches_if_full,
    compile_whole_programs,
    enable_compilation_cache,
    uses_compilation_cache,
    uses_few_parts,
)
from physxnet_jax.files import atomic_write


def test_existing_cache_settings_are_kept(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder() == tmp_path / "physxnet_jax"
    env = {"JAX_COMPILATION_CACHE_DIR": "/elsewhere"}
    enable_compilation_cache(env)
    assert env["JAX_COMPILATION_CACHE_DIR"] == "/elsewhere"
    empty: dict[str, str] = {}
    enable_compilation_cache(empty)
    folder = pathlib.Path(empty["JAX_COMPILATION_CACHE_DIR"])
    assert folder.parent == tmp_path / "physxnet_jax" / "programs"


def test_each_processor_has_its_own_cache_folder(monkeypatch):
    seen = set()
    for flags in ("flags: sse avx", "flags: sse"):
        monkeypatch.setattr("physxnet_jax._environment._processor", lambda f=flags: f)
        env: dict[str, str] = {}
        enable_compilation_cache(env)
        seen.add(env["JAX_COMPILATION_CACHE_DIR"])
    assert len(seen) == 2


def test_caches_are_cleared_before_memory_maps_run_out(monkeypatch, tmp_path):
    freed = []
    monkeypatch.setattr(jax, "clear_caches", lambda: freed.append(True))
    most, held = tmp_path / "most", tmp_path / "held"
    monkeypatch.setattr("physxnet_jax._environment._MAPS_ALLOWED", most)
    monkeypatch.setattr("physxnet_jax._environment._MAPS_HELD", held)
    assert not clear_caches_if_full(), "a system that doesn't say has no bound"
    most.write_text("100\n")
    held.write_text("map\n" * 59)
    assert not clear_caches_if_full() and not freed
    held.write_text("map\n" * 60)
    assert clear_caches_if_full() and len(freed) == 1
    assert not clear_caches_if_full(0.7)


@pytest.mark.release
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="maps are counted by Linux")
def test_cleared_programs_release_their_memory_maps():
    def held() -> int:
        return pathlib.Path("/proc/self/maps").read_bytes().count(b"\n")

    start = held()
    for k in range(40):
        jax.jit(lambda x, k=k: jnp.cumsum(jnp.sin(x) * k) @ x)(jnp.ones(8 + k))
    full = held()
    assert full > start + 40
    assert clear_caches_if_full(0.0) and held() < (start + full) / 2


@pytest.fixture
def run(tmp_path):
    def one(*words):
        set_by_tests = ("TF_CPP_MIN_LOG_LEVEL", "JAX_COMPILATION_CACHE_DIR")
        env = {k: v for k, v in os.environ.items() if k not in set_by_tests}
        env["XDG_CACHE_HOME"] = str(tmp_path / "cache")
        return subprocess.run(
            [pathlib.Path(sys.executable).parent / "physxnet", *words],
            env=env,
            capture_output=True,
            text=True,
            cwd=tmp_path,
        )

    return one


@pytest.mark.nightly
def test_second_run_uses_the_compilation_cache_silently(run, tmp_path):
    words = ("dress", "walk", "--wear", "bottom", "--method", "lbs", "--frames", "2", "--quiet")
    first = run(*words, "--out", "a.npz")
    assert first.returncode == 0, first.stderr
    kept = sorted((tmp_path / "cache").rglob("*-cache"))
    assert kept
    second = run(*words, "--out", "b.npz")
    assert second.returncode == 0 and second.stderr == first.stderr == ""
    assert sorted((tmp_path / "cache").rglob("*-cache")) == kept, "nothing new was compiled"
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def test_compilation_cache_is_off_for_commands_that_measure_it():
    assert uses_compilation_cache(["/usr/bin/physxnet", "dress", "walk"])
    assert uses_compilation_cache(["physxnet"]) and uses_compilation_cache(
        ["C:/bin/physxnet.exe", "train"]
    )
    assert not uses_compilation_cache(["physxnet", "bench", "net"])
    assert not uses_compilation_cache(["physxnet", "effects", "scene.toml"])
    assert not uses_compilation_cache(["my_program.py", "dress"])


def test_own_flags_of_xla_are_kept_and_unknown_versions_left_alone():
    env = {"XLA_FLAGS": "--xla_cpu_use_fusion_emitters=true --xla_a=1"}
    compile_whole_programs(env, "0.10.1")
    assert env["XLA_FLAGS"].split() == [
        "--xla_cpu_use_fusion_emitters=true",
        "--xla_a=1",
        "--xla_cpu_parallel_codegen_split_count=2",
    ]
    untried: dict[str, str] = {}
    compile_whole_programs(untried, "0.99.0")
    assert not untried


def test_commands_that_compute_for_long_compile_in_many_parts():
    assert uses_few_parts(["physxnet", "dress", "walk", "--wear", "top"])
    assert uses_few_parts(["physxnet.exe", "inspect", "coat.obj"])
    for words in ("simulate walk", "view", "train", "bench net", "dress walk --method simulate"):
        assert not uses_few_parts(["physxnet", *words.split()])
    assert not uses_few_parts(["physxnet", "dress", "walk", "--method=simulate"])
    assert not uses_few_parts(["physxnet"]) and not uses_few_parts(["other", "dress"])


FLAGS = """
import os, sys
sys.argv = [sys.argv[1], "dress"]
import physxnet_jax
import jax.numpy as jnp
# XLA would end the process at a flag that it doesn't know.
print(jnp.ones(3).sum(), os.environ.get("XLA_FLAGS", ""))
"""


@pytest.mark.parametrize("name", ["physxnet", "other"])
def test_commands_alone_set_flags_that_this_xla_knows(name):
    env = {k: v for k, v in os.environ.items() if k != "XLA_FLAGS"}
    out = subprocess.run(
        [sys.executable, "-c", FLAGS, name], capture_output=True, text=True, env=env
    )
    assert out.stdout.startswith("3.0"), out.stderr
    assert ("xla_cpu_use_fusion_emitters=false" in out.stdout) == (name == "physxnet")


HEAPS = """
import ctypes, sys, threading
sys.argv = [sys.argv[1]]
import physxnet_jax
gate = threading.Barrier(9)
def keep():
    ctypes.CDLL(None).malloc(1000)
    gate.wait()
for _ in range(8):
    threading.Thread(target=keep).start()
gate.wait()
libc = ctypes.CDLL(None)
libc.malloc_info(0, ctypes.c_void_p.in_dll(libc, "stdout"))
libc.fflush(None)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="heaps of glibc")
@pytest.mark.parametrize(("name", "several"), [("physxnet", False), ("other", True)])
def test_threads_of_a_command_share_a_heap(name, several):
    out = subprocess.run([sys.executable, "-c", HEAPS, name], capture_output=True, text=True)
    heaps = out.stdout.count("<heap nr=")
    assert (heaps > 1) == several and heaps, out.stderr


def test_concurrent_atomic_writes_leave_one_complete_file(tmp_path):
    """Every writer has a part of its own; the file is one of them, whole."""
    path, both = tmp_path / "a.txt", threading.Barrier(4)
    failed = []

    def write(text):
        try:
            with atomic_write(path) as part:
                part.write_text(text)
                both.wait(10)
        except Exception as error:
            failed.append(error)

    threads = [threading.Thread(target=write, args=(str(k) * 50,)) for k in range(4)]
    for t in threads:
        t.start()
    for t in threads:
        t.join()
    assert not failed and path.read_text() in {str(k) * 50 for k in range(4)}
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]
