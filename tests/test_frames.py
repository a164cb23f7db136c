"""Clips that don't fit in memory give what clips in memory give."""

import contextlib
import dataclasses
import errno
import pathlib
import re
import shutil
import subprocess
import sys
import time
import types

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from physxnet_jax import frames
from physxnet_jax.dressing import Inference, Simulation, dress
from physxnet_jax.errors import DiskFullError, FormatError
from physxnet_jax.frames import FrameStore, in_chunks, moved_frames, scratch_folder
from physxnet_jax.io import AnimatedMesh, check_output, write_clip
from physxnet_jax.motion import load_motion, save_motion


@pytest.fixture
def on_disk(monkeypatch, tmp_path):
    """Frames are kept in files, and read a few at a time."""
    monkeypatch.setattr(frames, "IN_MEMORY", 0)
    monkeypatch.setattr(frames, "_CHUNK", 200_000)
    with scratch_folder(tmp_path / "scratch"):
        yield tmp_path / "scratch"


@settings(max_examples=40, deadline=None)
@given(
    cuts=st.lists(st.integers(0, 30), max_size=5),
    vertices=st.integers(1, 40),
    wide=st.booleans(),
    in_file=st.booleans(),
    chunk=st.integers(1, 3000),
)
def test_what_is_appended_comes_back_in_order(cuts, vertices, wide, in_file, chunk):
    dtype = np.float64 if wide else np.float32
    whole = np.random.default_rng(0).normal(size=(30, vertices, 3)).astype(dtype)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(frames, "IN_MEMORY", 0 if in_file else 1 << 30)
        patch.setattr(frames, "_CHUNK", chunk)
        store = FrameStore(30)
        for block in np.split(whole, sorted(cuts)):
            store.append(block)
        found = store.array()
        assert found.dtype == dtype and type(found) is np.ndarray
        np.testing.assert_array_equal(found, whole)
        np.testing.assert_array_equal(np.concatenate(list(in_chunks(found))), whole)
        # A part of the vertices, as each garment of a simulation is.
        part = found[:, vertices // 2 :]
        np.testing.assert_array_equal(np.concatenate(list(in_chunks(part))), part)
        by = np.array([1.0, -2.0, 0.5], dtype)
        np.testing.assert_array_equal(moved_frames(found, by), whole + by)
        assert moved_frames(found, 0 * by) is found
        with pytest.raises(ValueError, match="31 frames, announced were 30"):
            store.append(whole[:1])


def test_files_have_no_name_and_stay_while_they_are_used(on_disk):
    store = FrameStore(4)
    store.append(np.ones((4, 5, 3), np.float32))
    found = store.array()
    del store
    assert on_disk.is_dir() and not list(on_disk.iterdir())
    assert found.sum() == 60 and not found.flags.writeable


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_what_was_read_leaves_memory(on_disk, monkeypatch):
    """And without giving it up it stays."""
    store = FrameStore(200)
    for _ in range(20):
        store.append(np.ones((10, 20_000, 3), np.float32))
    found = store.array()

    def held():
        return int(pathlib.Path("/proc/self/statm").read_text().split()[2]) * 4096

    # Of memory shared with files, 48 MB in all.
    before = held()
    for x in in_chunks(found):
        assert x.sum() == x.size
    assert held() - before < 5e6
    monkeypatch.setattr(frames, "_forget", lambda _: None)
    for x in in_chunks(found):
        assert x.sum() == x.size
    assert held() - before > 40e6


def test_too_little_room_is_noticed_before_the_work(on_disk, monkeypatch):
    usage = types.SimpleNamespace(free=1000)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage)
    with pytest.raises(DiskFullError, match=r"1 MB are needed .* 0 MB are free"):
        FrameStore(100).append(np.zeros((1, 1000, 3), np.float32))
    usage.free = 1 << 40
    FrameStore(100).append(np.zeros((1, 1000, 3), np.float32))


def test_a_disk_that_fills_is_one_sentence(on_disk, monkeypatch):
    store = FrameStore(100)
    store.append(np.zeros((1, 10, 3), np.float32))

    def write(_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(store, "_file", types.SimpleNamespace(write=write))
    with pytest.raises(DiskFullError, match="No space left on device"):
        store.append(np.zeros((1, 10, 3), np.float32))


def test_edits_of_a_mapping_in_memory_alone_are_kept(tmp_path):
    """As of `np.load(..., mmap_mode="c")`."""
    np.save(tmp_path / "x.npy", np.zeros((50, 30_000, 3), np.float32))
    x = np.load(tmp_path / "x.npy", mmap_mode="c")
    x += 1.0
    assert len(list(in_chunks(x))) > 1
    assert all(part.min() == 1.0 for part in in_chunks(x)) and x.min() == 1.0


def clip(frames=7):
    rng = np.random.default_rng(1)
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    x = rng.normal(size=(frames, 4, 3)).astype(np.float32)
    return [AnimatedMesh("sheet", x, faces), AnimatedMesh("other", x[::-1].copy(), faces)]


def on_file(meshes):
    out = []
    for m in meshes:
        store = FrameStore(len(m.positions))
        store.append(m.positions)
        out.append(dataclasses.replace(m, positions=store.array()))
    return out


def contents(folder):
    return {p.name: p.read_bytes() for p in folder.iterdir() if p.is_file()}


@pytest.mark.parametrize("suffix", ["npz", "pc2", "mdd", "obj", "glb"])
def test_files_are_equal_whatever_the_chunks(suffix, tmp_path, monkeypatch):
    for name in ("whole", "parts"):
        (tmp_path / name).mkdir()
    write_clip(tmp_path / "whole" / f"a.{suffix}", clip(), 30.0)
    monkeypatch.setattr(frames, "IN_MEMORY", 0)
    monkeypatch.setattr(frames, "_CHUNK", 100)
    write_clip(tmp_path / "parts" / f"a.{suffix}", on_file(clip()), 30.0)
    assert contents(tmp_path / "whole") == contents(tmp_path / "parts")


def test_usd_saved_in_parts_reads_the_same(tmp_path, monkeypatch):
    Usd = pytest.importorskip("pxr.Usd")
    write_clip(tmp_path / "whole.usdc", clip(), 30.0, velocities=True)
    monkeypatch.setattr(frames, "_CHUNK", 100)
    write_clip(tmp_path / "parts.usdc", clip(), 30.0, velocities=True)
    # A layer lives as long as its stage.
    stages = [Usd.Stage.Open(str(tmp_path / f"{name}.usdc")) for name in ("whole", "parts")]
    text = [stage.GetRootLayer().ExportToString() for stage in stages]
    assert text[0] == text[1] and text[0].count("velocities.timeSamples") == 2


def test_formats_that_are_held_in_memory_refuse_what_is_too_large(tmp_path):
    check_output(tmp_path / "a.glb", 200, 80_000)
    with pytest.raises(FormatError, match="too much for glTF"):
        check_output(tmp_path / "a.glb", 200, 90_000)
    check_output(tmp_path / "a.usda", 2000, 20_000)
    with pytest.raises(FormatError, match=r"too many for text: write .usdc"):
        check_output(tmp_path / "a.usda", 2000, 30_000)
    check_output(tmp_path / "a.usdc", 2000, 30_000)


@pytest.mark.sampled(2)
@pytest.mark.release
@pytest.mark.parametrize("method", ["lbs", "network", "guided", "simulate"])
def test_dressing_on_disk_is_dressing_in_memory(method, tmp_path):
    motion = load_motion("walk", fps=30.0)
    motion = dataclasses.replace(motion, rotations=motion.rotations[:20], root=motion.root[:20])
    motion = motion.moved(np.array([8.0, 0.0, -3.0], np.float32))
    options = {
        "method": method,
        "inference": Inference(weights="nano"),
        "simulation": Simulation(substeps=4),
        "frames": 20,
    }
    known = dress(motion, ["bottom", "top"], **options)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(frames, "IN_MEMORY", 0)
        patch.setattr(frames, "_CHUNK", 300_000)
        with scratch_folder(tmp_path):
            found = dress(motion, ["bottom", "top"], **options)
    for a, b in zip(known.meshes, found.meshes, strict=True):
        assert not b.positions.flags.writeable
        np.testing.assert_array_equal(a.positions, b.positions)
    assert known.inside == found.inside and known.worst == found.worst
    if known.rollout is not None and found.rollout is not None:
        for a, b in zip(known.rollout.positions, found.rollout.positions, strict=True):
            np.testing.assert_array_equal(a, b)


@pytest.mark.sampled(1)
@pytest.mark.release
@pytest.mark.parametrize("method", ["network", "guided"])
def test_dressing_goes_on_where_it_was_stopped(method, tmp_path):
    motion = load_motion("walk", fps=30.0)
    folder = tmp_path / "unfinished"
    options = {
        "method": method,
        "inference": Inference(weights="nano"),
        "frames": 40,
        "simulation": Simulation(substeps=4, resume=folder),
    }
    computed = []

    def stop(block):
        computed.append(block)
        if len(computed) == 2:
            raise KeyboardInterrupt

    with contextlib.suppress(KeyboardInterrupt):
        dress(motion, ["bottom"], on_block=stop, **options)
    assert len(list(folder.glob("block_*.npz"))) == 2
    blocks = []
    found = dress(motion, ["bottom"], on_block=blocks.append, **options)
    assert [np.isnan(b.milliseconds) for b in blocks] == [True, True, False]
    assert not folder.exists()
    known = dress(motion, ["bottom"], **options)
    np.testing.assert_array_equal(found.garments[0].positions, known.garments[0].positions)
    # Blocks of another clip are of no use.
    with contextlib.suppress(KeyboardInterrupt):
        dress(motion, ["bottom"], on_block=stop, **(options | {"frames": 20}))
    computed.clear()
    again = dress(motion, ["bottom"], on_block=computed.append, **options)
    assert not any(np.isnan(b.milliseconds) for b in computed)
    np.testing.assert_array_equal(again.garments[0].positions, known.garments[0].positions)


def long_walk(path, length):
    m = load_motion("walk", fps=30.0)
    turns, root = np.asarray(m.rotations), np.asarray(m.root)
    step = (root[-1] - root[0]) * [1, 0, 1]
    rounds = range(length // (len(root) - 1) + 1)
    turns = np.concatenate([turns[:-1] for _ in rounds])[:length]
    root = np.concatenate([root[:-1] + k * step for k in rounds])[:length].astype(np.float32)
    save_motion(path, dataclasses.replace(m, rotations=turns, root=root))


@pytest.mark.nightly
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize(
    ("command", "more", "suffix", "limit"),
    [
        ("dress", [], "usdc", 1500),
        ("dress", ["--method", "network"], "npz", 1500),
        ("dress", ["--method", "lbs"], "pc2", 1500),
        ("simulate", ["--accuracy", "draft"], "mdd", 1500),
    ],
)
def test_ten_thousand_frames_stay_in_memory(command, more, suffix, limit, tmp_path, promise):
    """Three garments and the body; programs are compiled by a short clip before."""
    length = 3000 if command == "simulate" else 10_000
    long_walk(tmp_path / "long.npz", length)
    script = pathlib.Path(sys.executable).with_name("physxnet")
    wear = ["--wear", "shirt", "trousers", "dress"]
    peak = 0.0
    for motion, out in (("walk", "short"), (tmp_path / "long.npz", "long")):
        words = [command, motion, *wear, *more, "-o", tmp_path / f"{out}.{suffix}"]
        process = subprocess.Popen([script, *map(str, words)], stdout=subprocess.DEVNULL)
        while process.poll() is None:
            with contextlib.suppress(OSError):
                status = pathlib.Path(f"/proc/{process.pid}/status").read_text()
                found = re.search(r"VmHWM:\s+(\d+)", status)
                peak = int(found[1]) / 1e3 if found else peak
            time.sleep(0.2)
        assert process.returncode == 0
    promise(
        "memory is bounded by the block", f"{command} {' '.join(more)} to .{suffix}", peak, "MB"
    )
    assert peak < limit
