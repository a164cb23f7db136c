"""Damaged input gives an answer or one clear error, and takes no more memory than it should."""

import base64
import json
import pathlib
import runpy
import tracemalloc

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st

from physxnet_jax.errors import PhysXNetError
from physxnet_jax.motion import load_motion

_READERS = runpy.run_path(str(pathlib.Path(__file__).with_name("readers.py")))
READERS, damaged, tried = (_READERS[name] for name in ("READERS", "damaged", "tried"))
BVH, OBJ, PLY, _gltf = (_READERS[name] for name in ("BVH", "OBJ", "PLY", "_gltf"))


def try_damages(name, folder, count):
    """How many of the damaged files were refused; all others are read."""
    blob = READERS[name][0](folder)
    assert tried(name, folder, blob), "the file that is damaged below is good"
    refused = 0

    @settings(max_examples=count, deadline=None, suppress_health_check=list(HealthCheck))
    @given(seed=st.integers(0, 2**32))
    def all_seeds(seed):
        nonlocal refused
        refused += not tried(name, folder, damaged(blob, seed))

    all_seeds()
    return refused


@pytest.mark.release
@pytest.mark.parametrize("name", READERS)
def test_damaged_files_are_read_or_refused(name, tmp_path):
    try_damages(name, tmp_path, READERS[name][3])


@pytest.mark.nightly
@pytest.mark.parametrize("name", READERS)
def test_a_thousand_damaged_files_are_read_or_refused(name, tmp_path, promise):
    refused = try_damages(name, tmp_path, 1000)
    share = 100 * refused / 1000
    promise("damaged files are read or refused", name, share, "% refused", tries=1000)


HUGE = {
    "bvh": BVH.replace("Frames: 2", "Frames: 1000000000").encode(),
    "obj": OBJ.replace("f 2 4 3", "f 2 4 999999999").encode(),
    "ply": PLY.replace(b"vertex 4", b"vertex 999999999"),
    "binary ply": PLY.replace(b"ascii", b"binary_little_endian").replace(
        b"vertex 4", b"vertex 999999999"
    ),
    "stl": b"\0" * 80 + np.array([10**9], "<u4").tobytes() + b"\0" * 100,
    "pc2": b"POINTCACHE2\0" + np.array([1, 10**9], "<i4").tobytes() + b"\0" * 12,
    "mdd": np.array([10**9, 10**9], ">i4").tobytes() + b"\0" * 64,
}


@pytest.mark.parametrize("name", HUGE)
def test_huge_numbers_in_small_files_take_no_memory(name, tmp_path):
    tracemalloc.start()
    assert not tried(name, tmp_path, HUGE[name])
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 50e6


def test_frames_times_joints_are_bounded(tmp_path):
    """Little text on either side of the product, none of it wrong."""
    document = json.loads(_gltf(tmp_path))
    blob = np.array([0, 9e8, 0, 1, 0, 0, 1.1, 0], "<f4").tobytes()
    document["buffers"][0]["uri"] = "data:;base64," + base64.b64encode(blob).decode()
    (tmp_path / "long.gltf").write_text(json.dumps(document))
    joints = "".join(f"JOINT j{k}\n{{\nOFFSET 0 1 0\nCHANNELS 0\n}}\n" for k in range(3000))
    head = BVH[: BVH.index("JOINT Knee")] + joints + "}\nMOTION\nFrames: 20000\nFrame Time: 0.01\n"
    (tmp_path / "wide.bvh").write_text(head + "0 1 0 0 0 0\n" * 20000)
    for name in ("long.gltf", "wide.bvh"):
        tracemalloc.start()
        with pytest.raises(PhysXNetError, match=name):
            load_motion(tmp_path / name)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 50e6


def test_oversized_archive_headers_take_no_memory(tmp_path):
    import io
    import zipfile

    header = io.BytesIO()
    fields = {"descr": "<f4", "fortran_order": False, "shape": (10**9, 31, 4)}
    np.lib.format.write_array_header_1_0(header, fields)
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as file:
        file.writestr("rotations.npy", header.getvalue() + b"\0" * 64)
        file.writestr("root.npy", header.getvalue())
    tracemalloc.start()
    with pytest.raises(PhysXNetError, match="announces"):
        load_motion(tmp_path / "a.npz")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 50e6


def test_objects_are_never_unpickled(tmp_path):
    class Trap:
        def __reduce__(self):
            return (pathlib.Path(tmp_path / "sprung").touch, ())

    trap = np.empty(1, object)
    trap[0] = Trap()
    np.savez(tmp_path / "a.npz", rotations=trap, root=trap, fps=trap, allow_pickle=True)
    with pytest.raises(PhysXNetError, match="objects"):
        load_motion(tmp_path / "a.npz")
    assert not (tmp_path / "sprung").exists()
