"""A USD file that lies about its own lengths costs neither memory nor the process."""

import resource
import struct
import subprocess
import sys
import time

import numpy as np
import pytest

from physxnet_jax.errors import FormatError
from physxnet_jax.io import _usd_trial, read_mesh

pytest.importorskip("pxr")
TEXT = """#usda 1.0
def Mesh "shirt"
{
    int[] faceVertexCounts = [3]
    int[] faceVertexIndices = [0, 1, 2]
    point3f[] points = [(0, 0, 0), (1, 0, 0), (1, 0, 1)]
}
"""


@pytest.fixture
def binary(tmp_path):
    from pxr import Usd

    (tmp_path / "a.usda").write_text(TEXT)
    path = tmp_path / "binary.usdc"
    Usd.Stage.Open(str(tmp_path / "a.usda")).Export(str(path))
    return path


def section(blob, name):
    """Where a section of a crate begins."""
    (toc,) = struct.unpack_from("<q", blob, 16)
    (count,) = struct.unpack_from("<q", blob, toc)
    for k in range(count):
        title, start, _ = struct.unpack_from("<16sqq", blob, toc + 8 + 32 * k)
        if title.rstrip(b"\0") == name:
            return start
    raise AssertionError(name)


@pytest.mark.skipif(sys.platform != "linux", reason="counts kilobytes, as Linux does")
def test_forged_usd_section_sizes_are_refused_without_allocation(binary):
    assert len(read_mesh(binary).vertices) == 3
    blob = bytearray(binary.read_bytes())
    # Tokens, and their size: 8 GB of them in a file of a kilobyte.
    struct.pack_into("<QQ", blob, section(blob, b"TOKENS"), 2**30, 2**33)
    binary.write_bytes(blob)
    before, began = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.monotonic()
    with pytest.raises(FormatError, match="damaged"):
        read_mesh(binary)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200_000
    assert time.monotonic() - began < 30.0


def test_usd_files_over_the_memory_or_time_limit_are_refused(binary, monkeypatch):
    with monkeypatch.context() as m:
        m.setattr(_usd_trial, "_BASE", 1_000_000)
        with pytest.raises(FormatError, match="damaged"):
            read_mesh(binary)
    with monkeypatch.context() as m:
        m.setattr(_usd_trial, "_SECONDS", 0.0)
        with pytest.raises(FormatError, match="time"):
            read_mesh(binary)
    np.testing.assert_array_equal(read_mesh(binary).faces, [[0, 1, 2]])


def test_usd_is_read_directly_where_no_subprocess_can_start(binary, monkeypatch):
    def forbidden(*words, **more):
        raise PermissionError

    with monkeypatch.context() as m:
        m.setattr(_usd_trial.subprocess, "run", forbidden)
        assert len(read_mesh(binary).vertices) == 3
        m.setattr(_usd_trial.sys, "executable", "/opt/studio/bin/studio")
        m.setattr(_usd_trial.subprocess, "run", None)
        assert len(read_mesh(binary).vertices) == 3


def test_usd_text_is_read_directly_but_its_references_are_tried_first(binary, monkeypatch):
    started = []
    real = _usd_trial.subprocess.run

    def noted(*words, **more):
        started.append(words)
        return real(*words, **more)

    monkeypatch.setattr(_usd_trial.subprocess, "run", noted)
    assert len(read_mesh(binary.with_name("a.usda")).vertices) == 3 and not started
    root = binary.with_name("root.usda")
    root.write_text('#usda 1.0\ndef "all" (references = @binary.usdc@</shirt>)\n{\n}\n')
    assert len(read_mesh(root).vertices) == 3 and len(started) == 1


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        (TEXT, False),
        (TEXT + 'def "a" {\n' * 50 + "}\n" * 50, False),
        (TEXT + 'def "a" {\n' * 200 + "}\n" * 200, True),
        (TEXT + 'def "b" (references = </shirt>) {}\n', True),
        (TEXT + 'def "b" (inherits = </shirt>) {}\n', True),
        (TEXT.replace("1.0", "1.0\n(subLayers = [@./b.usda@])", 1), True),
    ],
    ids=["plain", "nested", "deep", "references", "inherits", "layers"],
)
def test_usd_text_with_references_or_deep_nesting_is_tried(tmp_path, monkeypatch, text, wanted):
    tried = []
    (tmp_path / "a.usda").write_text(text)

    def run(words, **_):
        tried.append(words)
        return subprocess.CompletedProcess(words, 0)

    monkeypatch.setattr(_usd_trial.subprocess, "run", run)
    _usd_trial.try_stage(tmp_path / "a.usda")
    assert bool(tried) == wanted


def test_bracket_depth_does_not_depend_on_the_chunk_size(monkeypatch):
    text = b'def "a" { b = [(1, 2), (3, 4)] }' * 5
    assert _usd_trial._depth(b"") == 0
    for piece in (1, 3, 1000):
        monkeypatch.setattr(_usd_trial, "_PIECE", piece)
        assert _usd_trial._depth(text) == 3
