"""Files are replaced whole or not at all, and no file of a person's is destroyed."""

import contextlib
import errno
import os
import pathlib
import shutil
import signal
import subprocess
import sys

import numpy as np
import pytest

from physxnet_jax import files
from physxnet_jax.errors import BusyError, DiskFullError, FormatError
from physxnet_jax.files import (
    add_inputs,
    atomic_write,
    check_writable,
    claim,
    claims,
    keep_inputs,
)
from physxnet_jax.io import AnimatedMesh, check_output, write_clip


def write(path, text="new"):
    with atomic_write(path) as part:
        part.write_text(text)


def parts(folder):
    return sorted(p.name for p in folder.iterdir() if p.name.startswith(".part"))


@pytest.fixture
def clip():
    x = np.random.default_rng(0).normal(size=(4, 5, 3)).astype(np.float32)
    faces = np.array([[0, 1, 2], [2, 3, 4]])
    return [AnimatedMesh("top", x, faces), AnimatedMesh("bottom", x + 1.0, faces)]


def test_a_link_is_followed(tmp_path):
    there, link = tmp_path / "there.txt", tmp_path / "link.txt"
    there.write_text("old")
    link.symlink_to(there)
    write(link)
    assert link.is_symlink() and there.read_text() == "new"
    dangling = tmp_path / "dangling.txt"
    dangling.symlink_to(tmp_path / "not_yet.txt")
    write(dangling)
    assert dangling.is_symlink() and (tmp_path / "not_yet.txt").read_text() == "new"


def test_a_read_only_file_stays(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    path.chmod(0o444)
    for attempt in (write, check_writable):
        with pytest.raises(FormatError, match="read-only"):
            attempt(path)
    assert path.read_text() == "old" and not parts(tmp_path)
    path.chmod(0o644)
    write(path)
    assert path.read_text() == "new"


def test_inputs_stay_under_every_name(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    names = [path, tmp_path / "sub" / ".." / "a.txt", tmp_path / "link.txt", tmp_path / "hard.txt"]
    (tmp_path / "sub").mkdir()
    names[2].symlink_to(path)
    os.link(path, names[3])
    with keep_inputs():
        add_inputs(path, tmp_path / "missing", "\0", tmp_path)
        for name in names:
            for attempt in (write, check_writable):
                with pytest.raises(FormatError, match="this is an input"):
                    attempt(name)
        assert path.read_text() == "old"
        write(tmp_path / "b.txt")
    # The command is over.
    write(path)
    assert path.read_text() == "new"


def test_an_input_stays_when_it_is_moved_or_edited_but_its_inode_may_go_to_another(tmp_path):
    path, moved = tmp_path / "a.txt", tmp_path / "b.txt"
    path.write_text("old")
    with keep_inputs():
        add_inputs(path)
        os.utime(path, ns=(0, 0))
        with pytest.raises(FormatError, match="this is an input"):
            write(path)
        add_inputs(path)
        path.rename(moved)
        with pytest.raises(FormatError, match="this is an input"):
            write(moved)
        # As where the input was deleted and a new file took its number.
        os.utime(moved, ns=(1, 1))
        write(moved)
    assert moved.read_text() == "new"


def test_what_dead_processes_left_is_removed(tmp_path, monkeypatch):
    monkeypatch.setattr(files, "_swept", set())
    gone = subprocess.run(
        [sys.executable, "-c", "import os; print(os.getpid())"], capture_output=True, check=True
    )
    dead = f".part-{files._HOST}-{int(gone.stdout)}-1-a.txt"
    kept = [
        f".part-{files._HOST}-{os.getpid()}-1-a.txt",
        f".part-00000000-{int(gone.stdout)}-1-a.txt",
        ".part-mine",
    ]
    for name in (dead, *kept):
        (tmp_path / name).write_text("half")
    write(tmp_path / "a.txt")
    assert parts(tmp_path) == sorted(kept)


def test_a_full_disk_is_named(tmp_path, monkeypatch, clip):
    usage = shutil.disk_usage(tmp_path)
    path = tmp_path / "a.txt"
    path.write_text("old")

    def fail():
        with atomic_write(path) as part:
            part.write_bytes(bytes(3_000_000))
            raise RuntimeError("words of a library")

    with pytest.raises(RuntimeError, match="words"):
        fail()
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=1000))
    with pytest.raises(DiskFullError, match=r"a\.txt: the disk is full\. 3\.0 MB .* 0\.0 MB are"):
        fail()
    assert path.read_text() == "old" and not parts(tmp_path)
    # Before the work, where the size is known.
    with pytest.raises(DiskFullError, match="about 120 MB are needed, but 0 MB are free"):
        check_output(tmp_path / "a.pc2", 1000, 10_000)
    check_output(tmp_path / "a.pc2")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=100))
    for suffix in (".obj", ".npz", ".pc2", ".usdc", ".glb"):
        with pytest.raises(DiskFullError, match="fewer --frames"):
            write_clip(tmp_path / f"a{suffix}", clip, 30.0)
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


def test_a_sequence_appears_whole_or_not_at_all(tmp_path, clip, monkeypatch):
    from physxnet_jax.io import _write

    write_obj, calls = _write.write_obj, []

    def failing(*args, **options):
        calls.append(args[0])
        if len(calls) == 7:
            raise OSError("no more")
        return write_obj(*args, **options)

    for suffix in (".obj", ".mdd"):
        calls[:] = [None] * (5 if suffix == ".mdd" else 0)
        monkeypatch.setattr(_write, "write_obj", failing)
        with pytest.raises(OSError, match="no more"):
            write_clip(tmp_path / f"a{suffix}", clip, 30.0)
        assert not list(tmp_path.iterdir())
        monkeypatch.setattr(_write, "write_obj", write_obj)
        written = write_clip(tmp_path / f"a{suffix}", clip, 30.0)
        assert sorted(tmp_path.iterdir()) == sorted(written)
        assert len(written) == (8 if suffix == ".obj" else 4)
        for p in written:
            p.unlink()


@pytest.mark.release
@pytest.mark.skipif(shutil.which("mount") is None, reason="no mount")
def test_a_disk_that_is_really_full(tmp_path, clip):
    disk = tmp_path / "disk"
    disk.mkdir()
    options = ["mount", "-t", "tmpfs", "-o", "size=2m", "tmpfs", str(disk)]
    if os.geteuid() != 0 or subprocess.run(options, capture_output=True).returncode:
        pytest.skip("a small disk can't be mounted here")
    try:
        (disk / "filler").write_bytes(bytes(1_600_000))
        x = np.random.default_rng(0).normal(size=(12, 5000, 3)).astype(np.float32)
        big = [AnimatedMesh("top", x, clip[0].faces)]
        for suffix in (".obj", ".npz", ".pc2", ".mdd", ".usdc", ".glb"):
            with pytest.raises(DiskFullError, match="free"):
                write_clip(disk / f"a{suffix}", big, 30.0)
            # The writer itself finds it full too.
            with (
                pytest.MonkeyPatch.context() as patch,
                pytest.raises(DiskFullError, match="the disk is full"),
            ):
                patch.setattr("physxnet_jax.io._write.check_output", lambda p, *_: pathlib.Path(p))
                write_clip(disk / f"a{suffix}", big, 30.0)
            assert [p.name for p in disk.iterdir()] == ["filler"], suffix
    finally:
        with contextlib.suppress(OSError):
            subprocess.run(["umount", str(disk)], capture_output=True)


OWNER = """
import sys, time
from physxnet_jax.files import claim
with claim(sys.argv[1]):
    print("claimed", flush=True)
    time.sleep(float(sys.argv[2]))
"""


def owner(path, seconds):
    """Another process that has claimed a path, for some seconds."""
    words = [sys.executable, "-c", OWNER, str(path), str(seconds)]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline().strip() == "claimed"
    process.stdout.close()
    return process


def test_what_another_process_has_claimed_is_refused(tmp_path):
    target = tmp_path / "run"
    process = owner(target, 60.0)
    try:
        for _ in range(2):
            with pytest.raises(BusyError, match=f"run: in use by process {process.pid} on"):
                with claim(target):
                    pass
        with claim(tmp_path / "other"):
            pass
    finally:
        # The owner dies without a chance to tidy up.
        process.kill()
        process.wait()
    with claim(target), pytest.raises(BusyError, match=f"process {os.getpid()} on"):
        with claim(target):
            pass
    with claim(target):
        pass
    assert not list(tmp_path.iterdir()), "no lock is left"


def test_without_locks_of_the_file_system_work_goes_on(tmp_path, monkeypatch):
    fcntl = pytest.importorskip("fcntl")

    def fail(code):
        def flock(*_):
            raise OSError(code, os.strerror(code))

        monkeypatch.setattr(fcntl, "flock", flock)

    fail(errno.ENOLCK)
    with claim(tmp_path / "run"):
        pass
    # Any other failure is that failure, not another owner.
    fail(errno.EIO)
    with pytest.raises(OSError, match=os.strerror(errno.EIO)), claim(tmp_path / "run"):
        pass


def test_who_waits_comes_after_the_owner(tmp_path):
    process = owner(tmp_path / "cache.json", 1.0)
    with claim(tmp_path / "cache.json", wait=True):
        # Its last words were spoken.
        assert process.wait(20) == 0


def test_a_decorated_function_claims_what_its_argument_names(tmp_path):
    @claims("folder", unless=lambda: free)
    def work(x, folder=None):
        return x, list(tmp_path.iterdir())

    free = False
    assert work(1) == (1, []) and work(2, None) == (2, [])
    assert work(3, tmp_path / "a")[1] == work(3, folder=tmp_path / "a")[1] != []
    with claim(tmp_path / "a"):
        with pytest.raises(BusyError):
            work(4, tmp_path / "a")
        free = True
        assert work(5, tmp_path / "a")[0] == 5


def test_long_work_is_refused_where_another_process_is_at_it(tmp_path):
    from physxnet_jax.data import DatasetConfig, build_dataset, write_protocol
    from physxnet_jax.dressing import adapt
    from physxnet_jax.garment import template
    from physxnet_jax.motion import procedural_clip, save_motion
    from physxnet_jax.simulation import Scene, simulate
    from physxnet_jax.training import TrainConfig, train

    clip, scene = procedural_clip("walk", seconds=0.2), Scene((template("bottom"),))
    motions = tmp_path / "motions"
    motions.mkdir()
    save_motion(motions / "walk.npz", clip)
    write_protocol(motions)
    there = tmp_path / "there"
    with claim(there):
        for work in (
            lambda: simulate(scene, clip, resume=there),
            lambda: adapt("bottom", resume=there),
            lambda: train(TrainConfig(), [], there),
            lambda: build_dataset(DatasetConfig(), there, motions),
        ):
            with pytest.raises(BusyError, match=f"there: in use by process {os.getpid()}"):
                work()
    assert not there.exists()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_wait_for_the_end_and_act_then(number):
    reached = []

    def stop(*_):
        raise KeyboardInterrupt

    before = signal.signal(number, stop)
    try:
        with pytest.raises(KeyboardInterrupt), files.uninterrupted():
            signal.raise_signal(number)
            reached.append("held")
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(number)
            reached.append("open")
        # What fails by itself says so.
        with pytest.raises(ZeroDivisionError), files.uninterrupted():
            signal.raise_signal(number)
            1 / 0  # noqa: B018
        assert signal.getsignal(number) is stop
    finally:
        signal.signal(number, before)
    assert reached == ["held"]


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes")
def test_what_is_no_ordinary_file_is_not_replaced(tmp_path):
    os.mkfifo(tmp_path / "pipe.npz")
    (tmp_path / "link.npz").symlink_to(tmp_path / "pipe.npz")
    for name in ("pipe.npz", "link.npz"):
        with pytest.raises(FormatError, match="ordinary file"), atomic_write(tmp_path / name):
            pass
    assert (tmp_path / "pipe.npz").is_fifo()


def test_links_to_themselves_and_long_names_are_refused_before_the_work(tmp_path):
    (tmp_path / "self.npz").symlink_to(tmp_path / "self.npz")
    with pytest.raises(FormatError, match="leads to itself"):
        check_writable(tmp_path / "self.npz")
    check_writable(tmp_path / ("n" * 180 + ".npz"))
    with pytest.raises(FormatError, match="too long"):
        check_writable(tmp_path / ("n" * 225 + ".npz"))
