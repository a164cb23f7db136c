"""Files of a few megabytes take at most 500 MB, whatever is in them."""

import json
import pathlib
import runpy
import subprocess
import sys

import numpy as np
import pytest

_READERS = runpy.run_path(str(pathlib.Path(__file__).with_name("readers.py")))
SMALL, LIMIT = 10_000_000, 500.0


def grid(n):
    """A square sheet's vertices and triangles."""
    x, y = (a.ravel() for a in np.meshgrid(np.arange(n), np.arange(n)))
    points = np.stack([x, y, 0 * x], 1) / n
    a = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    return points, np.concatenate(
        [np.stack([a, a + 1, a + n], 1), np.stack([a + 1, a + n + 1, a + n], 1)]
    )


def text_obj(path):
    points, faces = grid(370)
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in points]
    lines += [f"f {a}/1/1 {b}/1/1 {c}/1/1" for a, b, c in faces + 1]
    path.write_text("vt 0 0\nvn 0 0 1\n" + "\n".join(lines[: len(points) + 150_000]))


def text_ply(path):
    points, faces = grid(330)
    head = (
        f"ply\nformat ascii 1.0\nelement vertex {len(points)}\nproperty float x\nproperty float y\n"
        f"property float z\nelement face {len(faces)}\nproperty list uchar int vertex_indices\n"
        "end_header\n"
    )
    with path.open("w") as file:
        file.write(head)
        np.savetxt(file, points, "%.6f")
        np.savetxt(file, np.insert(faces, 0, 3, axis=1), "%d")


def binary_stl(path):
    points, faces = grid(310)
    rows = np.zeros(len(faces), [("n", "<f4", 3), ("p", "<f4", (3, 3)), ("a", "<u2")])
    rows["p"] = points[faces]
    path.write_bytes(b"\0" * 80 + np.array([len(faces)], "<u4").tobytes() + rows.tobytes())


def long_bvh(path):
    head, _, rows = _READERS["_SAMPLES"]["standing_bvh"]().partition("Frames:")
    row = rows.strip().splitlines()[-1]
    count = 9_500_000 // (len(row) + 1)
    path.write_text(f"{head}Frames: {count}\nFrame Time: 0.033333\n" + f"{row}\n" * count)


def person_of_zeros(path):
    """What a kilobyte of zeros unpacks to."""
    faces = np.stack([np.arange(9998), np.arange(9998) + 1, np.arange(9998) + 2], 1)
    np.savez_compressed(
        path, positions=np.zeros((3000, 10_000, 3), np.float32), faces=faces, fps=np.array(30.0)
    )


def person(path):
    """Numbers that hardly repeat."""
    x = np.random.default_rng(0).uniform(0, 1.7, size=(120, 5000, 3)).astype(np.float32)
    faces = np.stack([np.arange(4998), np.arange(4998) + 1, np.arange(4998) + 2], 1)
    np.savez_compressed(path, positions=x, faces=faces, fps=np.array(30.0))


def motion_of_zeros(path):
    turns = np.zeros((700_000, 31, 4), np.float32)
    turns[..., 0] = 1
    np.savez_compressed(path, rotations=turns, root=np.zeros((700_000, 3), np.float32), fps=30.0)


def smpl_of_zeros(path):
    poses = np.zeros((700_000, 156), np.float32)
    trans = np.zeros((700_000, 3), np.float32)
    np.savez_compressed(path, poses=poses, trans=trans, mocap_framerate=30.0)


def gltf_without_data(path):
    """Accessors without a view are zeros by the standard, as many as they say."""
    document = json.loads(_READERS["_skin"](path.parent))
    for accessor in document["accessors"]:
        if accessor["type"] == "VEC3":
            accessor.pop("bufferView")
            accessor["count"] = 60_000_000
    path.write_text(json.dumps(document))


def stage_of_zeros(path):
    """Whole numbers are packed in a crate, and equal ones take nothing."""
    from pxr import Usd, UsdGeom, Vt

    stage = Usd.Stage.CreateNew(str(path))
    mesh = UsdGeom.Mesh.Define(stage, "/shirt")
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(np.eye(3, dtype=np.float32)))
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(20_000_000, 3, np.int32)))
    indices = np.tile(np.arange(3, dtype=np.int32), 20_000_000)
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(indices))
    stage.GetRootLayer().Save()


CASES = {
    "obj": (text_obj, ".obj", "obj"),
    "ply": (text_ply, ".ply", "ply"),
    "stl": (binary_stl, ".stl", "stl"),
    "bvh": (long_bvh, ".bvh", "bvh of a person"),
    "person of zeros": (person_of_zeros, ".npz", "character"),
    "person": (person, ".npz", "character"),
    "motion of zeros": (motion_of_zeros, ".npz", "motion"),
    "smpl of zeros": (smpl_of_zeros, ".npz", "amass"),
    "gltf without data": (gltf_without_data, ".gltf", "skin"),
    "garment without data": (gltf_without_data, ".gltf", "garment skin"),
    "stage of zeros": (stage_of_zeros, ".usdc", "binary garment usd"),
}
SCRIPT = """
import pathlib, re, runpy, sys
readers, name, path, small = sys.argv[1:]
made = runpy.run_path(readers)
reader = made["READERS"][name][2]
held = lambda what: int(re.search(what + r":\\s+(\\d+)", pathlib.Path("/proc/self/status").read_text())[1]) / 1e3
try:
    reader(pathlib.Path(small))
except made["PhysXNetError"]:
    pass
pathlib.Path("/proc/self/clear_refs").write_text("5")
before = held("VmRSS")
try:
    reader(pathlib.Path(path))
    print("read", end=" ")
except made["PhysXNetError"] as error:
    print("refused", end=" ")
    print(error, file=sys.stderr)
print(held("VmHWM") - before)
"""


@pytest.mark.sampled(5)
@pytest.mark.release
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize("case", CASES)
def test_small_files_take_little_memory(case, tmp_path, promise):
    make, suffix, name = CASES[case]
    path, small = tmp_path / f"file{suffix}", tmp_path / f"small{suffix}"
    # Libraries and programs are loaded by a good small file first.
    small.write_bytes(_READERS["READERS"][name][0](tmp_path))
    make(path)
    assert path.stat().st_size < SMALL
    words = [pathlib.Path(__file__).with_name("readers.py"), name, path, small]
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, *map(str, words)], capture_output=True, text=True, check=True
    )
    outcome, peak = done.stdout.split()[-2:]
    promise("small files take little memory", f"{case}, {outcome}", float(peak), "MB")
    assert float(peak) < LIMIT, (outcome, peak)
    if "zeros" not in case and "data" not in case:
        assert outcome == "read"
