"""What is said of broken files: a corpus, every reader, every message.

Command: python experiments/broken_files.py
Cost:    half a minute.
Result:  experiments/results/broken_files.md, shown in docs/broken-files.md.
"""

# ruff: noqa: E501
import io
import json
import pathlib
import tempfile
import zipfile
from collections.abc import Callable

import numpy as np

from physxnet_jax.dressing import load_scene, read_character
from physxnet_jax.errors import PhysXNetError
from physxnet_jax.files import atomic_write
from physxnet_jax.io import read_mdd, read_mesh, read_obj, read_pc2
from physxnet_jax.models import load_predictor
from physxnet_jax.motion import load_motion, read_joint_map

RESULT = pathlib.Path(__file__).parent / "results/broken_files.md"
JOINT = "CHANNELS 3 Zrotation Yrotation Xrotation"
BVH = (
    "HIERARCHY\nROOT Hips\n{\nOFFSET 0 0 0\nCHANNELS 6 Xposition Yposition Zposition"
    " Zrotation Yrotation Xrotation\nJOINT Knee\n{\nOFFSET 0 -1 0\n"
    + JOINT
    + "\nEnd Site\n{\nOFFSET 0 -1 0\n}\n}\n}\nMOTION\nFrames: 1\nFrame Time: 0.0083333\n"
    "0 1 0 0 0 0 0 0 0\n"
)
PLY = (
    b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
    b"property float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
    b"0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
)
USDA = """#usda 1.0
def Mesh "shirt" (prepend apiSchemas = ["SkelBindingAPI"])
{
    int[] faceVertexCounts = [3]
    int[] faceVertexIndices = [0, 1, 2]
    point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]
    matrix4d primvars:skel:geomBindTransform = BIND
}
"""
OBJ = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"


def archive(**arrays: object) -> bytes:
    blob = io.BytesIO()
    np.savez(blob, **arrays)  # pyright: ignore[reportArgumentType]
    return blob.getvalue()


def announcing() -> bytes:
    """An archive whose header tells of more than it holds."""
    header, blob = io.BytesIO(), io.BytesIO()
    told = {"descr": "<f4", "fortran_order": False, "shape": (10**9, 31, 4)}
    np.lib.format.write_array_header_1_0(header, told)
    with zipfile.ZipFile(blob, "w") as file:
        file.writestr("rotations.npy", header.getvalue())
    return blob.getvalue()


def gltf(**change: object) -> bytes:
    """A document of two nodes, changed."""
    document = {
        "asset": {"version": "2.0"},
        "nodes": [{"name": "a", "children": [1]}, {"name": "b"}],
        "skins": [{"joints": [0, 1]}],
        "accessors": [{"componentType": 5126, "count": 2, "type": "SCALAR", "bufferView": 0}],
        "bufferViews": [{"buffer": 0, "byteLength": 8}],
        "buffers": [{"byteLength": 8, "uri": "data:application/octet-stream;base64,AAAAAAAAgD8="}],
        "animations": [
            {
                "channels": [{"sampler": 0, "target": {"node": 1, "path": "translation"}}],
                "samplers": [{"input": 0, "output": 0}],
            }
        ],
    }
    return json.dumps(document | change).encode()


def corpus() -> list[tuple[str, str, bytes, Callable[[pathlib.Path], object]]]:
    """What is wrong, the file's name, its bytes, its reader."""
    objects = np.array([None, {}], dtype=object)
    huge = {"componentType": 5126, "count": 10**9, "type": "SCALAR", "bufferView": 0}
    view = np.array([1, 10**9], "<i4").tobytes()
    return [
        ("empty", "a.bvh", b"", load_motion),
        ("binary", "a.bvh", b"\0\1\2\3" * 9, load_motion),
        ("truncated in the hierarchy", "a.bvh", BVH[:120].encode(), load_motion),
        ("fewer frames than announced", "a.bvh", BVH.replace(": 1\n", ": 9\n").encode(), load_motion),
        ("a billion frames announced", "a.bvh", BVH.replace(": 1\n", ": 1000000000\n").encode(), load_motion),
        ("NaN", "a.bvh", BVH.replace("0 1 0 0", "0 nan 0 0").encode(), load_motion),
        ("a brace too many", "a.bvh", BVH.replace("End Site", "}\n}\n}\nEnd Site").encode(), load_motion),
        ("beyond any measure", "a.bvh", BVH.replace("OFFSET 0 -1 0", "OFFSET 0 -1e308 0").encode(), load_motion),
        ("a byte order mark alone", "a.bvh", b"\xef\xbb\xbf", load_motion),
        ("unknown joints", "a.bvh", BVH.encode(), load_motion),
        ("not UTF-8", "a.bvh", BVH.encode().replace(b"Hips", b"\xff\xfe"), load_motion),
        ("no skeleton beside it", "01_02.amc", b":DEGREES\n1\nroot 0 0 0 0 0 0\n", load_motion),
        ("no archive", "a.npz", b"PK\3\4 broken", load_motion),
        ("Python objects inside", "a.npz", archive(rotations=objects, root=objects, fps=1), load_motion),
        ("more announced than held", "a.npz", announcing(), load_motion),
        ("poses of too few joints", "a.npz", archive(poses=np.zeros((4, 30)), trans=np.zeros((4, 3))), load_motion),
        ("NaN in poses", "a.npz", archive(poses=np.full((4, 156), np.nan), trans=np.zeros((4, 3)), mocap_framerate=30.0), load_motion),
        ("rotations that are none", "a.npz", archive(poses=np.full((4, 156), 1e200), trans=np.zeros((4, 3)), mocap_framerate=30.0), load_motion),
        ("millions of frames of nothing", "a.npz", archive(rotations=np.zeros((4_000_000, 2, 4), "u1"), root=np.zeros((4_000_000, 3), "u1"), fps=30.0), load_motion),
        ("no glTF", "a.gltf", b"{", load_motion),
        ("glTF 1", "a.gltf", gltf(asset={"version": "1.0"}), load_motion),
        ("nodes in a circle", "a.gltf", gltf(nodes=[{"children": [1]}, {"children": [0]}]), load_motion),
        ("a billion keys announced", "a.gltf", gltf(accessors=[huge]), load_motion),
        ("a path out of its folder", "a.gltf", gltf(buffers=[{"byteLength": 8, "uri": "../../secret.bin"}]), load_motion),
        ("a web address", "a.gltf", gltf(buffers=[{"byteLength": 8, "uri": "https://example.org/a.bin"}]), load_motion),
        ("FBX", "a.fbx", b"Kaydara FBX Binary", load_motion),
        ("no joint of the body", "names.toml", b'Hip = "pelvis"', read_joint_map),
        ("no faces", "a.obj", b"v 0 0 0\n", read_obj),
        ("index out of range", "a.obj", OBJ.replace("f 1 2 3", "f 1 2 9").encode(), read_obj),
        ("index zero", "a.obj", OBJ.replace("f 1 2 3", "f 0 1 2").encode(), read_obj),
        ("infinite", "a.obj", OBJ.replace("v 1 0 0", "v 1e999 0 0").encode(), read_obj),
        ("binary", "a.obj", b"\0\0\0\0", read_obj),
        ("no such format", "shirt.fbx", b"Kaydara FBX Binary", read_mesh),
        ("a billion vertices announced", "shirt.ply", PLY.replace(b"vertex 3", b"vertex 1000000000"), read_mesh),
        ("faces that lead nowhere", "shirt.ply", PLY.replace(b"3 0 1 2", b"3 0 1 9"), read_mesh),
        ("a billion triangles announced", "shirt.stl", b"\0" * 80 + np.array([10**9], "<u4").tobytes(), read_mesh),
        ("faces that lead nowhere", "shirt.usda", USDA.replace("0, 1, 2]", "0, 1, 9]").replace("= BIND", "= ((1,0,0,0), (0,1,0,0), (0,0,1,0), (0,0,0,1))").encode(), read_mesh),
        ("bound by no matrix", "shirt.usda", USDA.replace("matrix4d", "float").replace("BIND", "1").encode(), read_mesh),
        ("no mesh", "shirt.gltf", gltf(), read_mesh),
        ("truncated cache", "a.pc2", b"POINTCACHE2\0" + view + b"\0" * 12, read_pc2),
        ("truncated cache", "a.mdd", b"\0\0\0\5\0\0\0\5\0\0", read_mdd),
        ("a person without faces", "me.npz", archive(positions=np.zeros((2, 9, 3))), read_character),
        ("of no person's height", "me.npz", archive(positions=np.ones((2, 9, 3)), faces=np.arange(9).reshape(3, 3)), read_character),
        ("a cache without its faces", "me.pc2", b"POINTCACHE2\0" + view, read_character),
        ("no stage", "me.usda", b"#usda 1.0\n(", read_character),
        ("nested without end", "me.usda", b"#usda 1.0\n" + b'def "a" {\n' * 60_000, read_character),
        ("nested without end", "scene.toml", b"motion = " + b"[" * 5000, load_scene),
        ("unknown effect", "scene.toml", b'motion = "walk"\n[effects.magic]\n', load_scene),
        ("wrong kind of value", "scene.toml", b'motion = "walk"\nframes = "ten"\n', load_scene),
        ("unknown weights", "none", b"", lambda path: load_predictor(path.name)),
    ]  # fmt: skip


def table() -> str:
    """A line for each file; paths are shortened to names."""
    lines = ["| file | what is wrong | what is said |", "|---|---|---|"]
    with tempfile.TemporaryDirectory() as name:
        for wrong, file, blob, reader in corpus():
            path = pathlib.Path(name) / file
            path.write_bytes(blob)
            try:
                reader(path)
                said = "(read)"
            except PhysXNetError as error:
                said = str(error).replace(f"{name}/", "").replace("|", "/").replace("\n", " ")
            path.unlink()
            lines.append(f"| `{file}` | {wrong} | {said} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    text = table()
    with atomic_write(RESULT) as part:
        part.write_text(text)
    page = RESULT.parents[2] / "docs/broken-files.md"
    head, _, rest = page.read_text().partition("<!-- begin broken_files -->\n")
    tail = rest.partition("<!-- end broken_files -->")[2]
    marks = ("<!-- begin broken_files -->\n", "<!-- end broken_files -->")
    with atomic_write(page) as part:
        part.write_text(head + marks[0] + text + marks[1] + tail)


if __name__ == "__main__":
    main()
