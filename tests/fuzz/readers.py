"""Readers of files from anywhere, a good file of each, and how to damage it.

`python tests/fuzz/readers.py SECONDS` damages files until the time is over, with other seeds each time.
"""

import base64
import dataclasses
import hashlib
import json
import pathlib
import random
import runpy
import shutil
import sys
import tempfile
import time

import jax
import jax.numpy as jnp
import numpy as np
import trimesh

from physxnet_jax.data import (
    list_sequences,
    open_dataset,
    read_note,
    read_protocol,
    read_sequence,
    write_action,
    write_garment,
    write_offsets,
)
from physxnet_jax.dressing import load_scene, read_character
from physxnet_jax.errors import FormatError, PhysXNetError
from physxnet_jax.garment import find_fabric, square_sheet
from physxnet_jax.io import read_mdd, read_mesh, read_obj, read_pc2
from physxnet_jax.models import load_predictor
from physxnet_jax.motion import load_motion, read_amc, read_bvh, read_joint_map
from physxnet_jax.simulation import Resume
from physxnet_jax.training import Checkpoints

_SAMPLES = runpy.run_path(str(pathlib.Path(__file__).parents[1] / "samples.py"))
BVH, ASF, AMC = (_SAMPLES[name] for name in ("BVH", "ASF", "AMC"))
OBJ = "o a\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 1\nvt 0 0\nvt 1 1\nf 1/1 2/2 3/1\nf 2 4 3\nf -1 -2 -3 -4\n"
SCENE = (
    'motion = "balance"\nframes = 2\ngarments = ["bottom"]\n[effects.air]\nwind = [0.0, 0.0, 4.0]\n'
)
PLY = (
    b"ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\n"
    b"property float z\nelement face 2\nproperty list uchar int vertex_indices\nend_header\n"
    b"0 0 0\n1 0 0\n0 1 0\n1 1 1\n3 0 1 2\n3 1 3 2\n"
)
MTL = "newmtl red\nKd 1 0 0\nd 0.5\nmap_Kd -s 1 1 1 red.png\n\nnewmtl blue\nKd 0 0 1\nNs 10\n"
ACTIONS = b"split,action,file,start_s,frames_at_30fps,note\ntrain,walk,a.bvh,0.5,20,x\ntest,run,b.bvh,0,9,\n"
CLIPS = b"file,fps\na.bvh,120\nb.bvh,60\n"
FABRIC = 'base = "wool"\ndensity = 0.19\nbend = 3e-5\nwarp = 2600.0\n'

NAMES = 'Hips = "a"\nLeftLeg = "b"\n'


def _npz(folder, **arrays):
    np.savez(folder / "good.npz", **arrays)
    return (folder / "good.npz").read_bytes()


def _clip(folder):
    rotations = np.zeros((3, 31, 4), np.float32)
    rotations[..., 0] = 1
    return _npz(folder, rotations=rotations, root=np.zeros((3, 3), np.float32), fps=30.0)


def _amass(folder):
    poses = np.zeros((3, 156), np.float32)
    return _npz(folder, poses=poses, trans=np.zeros((3, 3), np.float32), mocap_framerate=30.0)


def _gltf(folder):
    """A standing figure of Mixamo's joints whose hips rise, as one text."""
    places = {
        "Hips": (None, (0, 1, 0)),
        **{f"{s}UpLeg": ("Hips", (x, 0, 0)) for s, x in (("Left", 0.1), ("Right", -0.1))},
        **{f"{s}{b}": (f"{s}{a}", (0, -0.4, 0)) for s in ("Left", "Right")
           for a, b in (("UpLeg", "Leg"), ("Leg", "Foot"))},
        **{f"{s}Arm": ("Hips", (x, 0.5, 0)) for s, x in (("Left", 0.2), ("Right", -0.2))},
        **{f"{s}{b}": (f"{s}{a}", (x, 0, 0)) for s, x in (("Left", 0.25), ("Right", -0.25))
           for a, b in (("Arm", "ForeArm"), ("ForeArm", "Hand"))},
    }  # fmt: skip
    names = list(places)
    nodes = [
        {"name": n, "translation": list(places[n][1]),
         "children": [k for k, m in enumerate(names) if places[m][0] == n]}
        for n in names
    ]  # fmt: skip
    blob = np.array([0, 0.1, 0, 1, 0, 0, 1.1, 0], "<f4").tobytes()
    uri = "data:application/octet-stream;base64," + base64.b64encode(blob).decode()
    document = {
        "asset": {"version": "2.0"},
        "nodes": nodes,
        "skins": [{"joints": list(range(len(names)))}],
        "buffers": [{"byteLength": len(blob), "uri": uri}],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": 8},
            {"buffer": 0, "byteOffset": 8, "byteLength": 24},
        ],
        "accessors": [
            {"componentType": 5126, "count": 2, "type": "SCALAR", "bufferView": 0},
            {"componentType": 5126, "count": 2, "type": "VEC3", "bufferView": 1},
        ],
        "animations": [
            {
                "channels": [{"sampler": 0, "target": {"node": 0, "path": "translation"}}],
                "samplers": [{"input": 0, "output": 1}],
            }
        ],
    }
    return json.dumps(document, indent=1).encode()


def _pc2(folder):
    from physxnet_jax.io._pc2 import write_pc2

    write_pc2(folder / "a.pc2", np.zeros((2, 3, 3), np.float32))
    return (folder / "a.pc2").read_bytes()


def _mdd(folder):
    from physxnet_jax.io import write_mdd

    write_mdd(folder / "a.mdd", np.zeros((2, 3, 3), np.float32), 30.0)
    return (folder / "a.mdd").read_bytes()


def _character(folder):
    x = np.array([[0, 0, 0], [1, 0, 0], [0, 1.7, 0]], np.float32)
    return _npz(folder, positions=np.stack([x, x + 0.1]), faces=np.array([[0, 1, 2]]), fps=30.0)


def _png(folder):
    from PIL import Image

    Image.new("RGB", (3, 2), (200, 10, 10)).save(folder / "good.png")
    return (folder / "good.png").read_bytes()


def _usda(folder):
    return b"""#usda 1.0
(
    endTimeCode = 1
    startTimeCode = 0
    timeCodesPerSecond = 30
    upAxis = "Y"
)
def Mesh "body"
{
    int[] faceVertexCounts = [3]
    int[] faceVertexIndices = [0, 1, 2]
    point3f[] points.timeSamples = {
        0: [(0, 0, 0), (1, 0, 0), (0, 1.7, 0)],
        1: [(0, 0, 0), (1, 0, 0), (0, 1.8, 0)],
    }
}
"""


def _garment_usda(folder):
    return b"""#usda 1.0
def Mesh "shirt" (prepend apiSchemas = ["SkelBindingAPI"])
{
    int[] faceVertexCounts = [4]
    int[] faceVertexIndices = [0, 1, 2, 3]
    point3f[] points = [(0, 0, 0), (1, 0, 0), (1, 0, 1), (0, 0, 1)]
    texCoord2f[] primvars:st = [(0, 0), (1, 0)] (interpolation = "faceVarying")
    int[] primvars:st:indices = [0, 1, 1, 0]
    matrix4d primvars:skel:geomBindTransform = ((1,0,0,0), (0,1,0,0), (0,0,1,0), (0,0,0,1))
    double3 xformOp:translate = (9, 0, 0)
    uniform token[] xformOpOrder = ["xformOp:translate"]
}
"""


def _garment_usdc(folder):
    """The same in USD's binary form."""
    from pxr import Usd

    (folder / "text.usda").write_bytes(_garment_usda(folder))
    Usd.Stage.Open(str(folder / "text.usda")).Export(str(folder / "binary.usdc"))
    return (folder / "binary.usdc").read_bytes()


def _binary(document):
    """A glTF's text as a GLB of one chunk."""
    text = document + b" " * (-len(document) % 4)
    head = b"glTF" + np.array([2, 20 + len(text), len(text)], "<u4").tobytes()
    return head + b"JSON" + text


def _exported(kind):
    box = trimesh.creation.box()
    return box.export(file_type=kind)


def _skin(folder):
    """Two triangles that hang on the figure's hips."""
    document = json.loads(_gltf(folder))
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1.7, 0], [1, 1, 0]], "<f4")
    faces = np.array([0, 1, 2, 1, 3, 2], "<u2")
    share = np.tile(np.array([1, 0, 0, 0], "<f4"), (4, 1))
    blob = points.tobytes() + faces.tobytes() + np.zeros((4, 4), "u1").tobytes()
    blob = blob + b"\0" * (-len(blob) % 4) + share.tobytes()
    uri = "data:application/octet-stream;base64," + base64.b64encode(blob).decode()
    n, m, b = (len(document[k]) for k in ("accessors", "bufferViews", "buffers"))
    document["buffers"].append({"byteLength": len(blob), "uri": uri})
    starts, sizes = (0, 48, 60, 76), (48, 12, 16, 64)
    document["bufferViews"] += [
        {"buffer": b, "byteOffset": s, "byteLength": k} for s, k in zip(starts, sizes)
    ]
    kinds = ((5126, 4, "VEC3"), (5123, 6, "SCALAR"), (5121, 4, "VEC4"), (5126, 4, "VEC4"))
    document["accessors"] += [
        {"bufferView": m + k, "componentType": c, "count": q, "type": t}
        for k, (c, q, t) in enumerate(kinds)
    ]
    attributes = {"POSITION": n, "JOINTS_0": n + 2, "WEIGHTS_0": n + 3}
    document["meshes"] = [{"primitives": [{"attributes": attributes, "indices": n + 1}]}]
    document["nodes"].append({"name": "figure", "mesh": 0, "skin": 0})
    return json.dumps(document).encode()


def _amc(path):
    path.with_suffix(".asf").write_text(ASF)
    return read_amc(path, path.with_suffix(".asf"))


def _asf(path):
    (path.parent / "a.amc").write_text(AMC)
    return read_amc(path.parent / "a.amc", path)


def _materials(path):
    """What an OBJ says of colours and pictures, in the file beside it."""
    (path.parent / "a.obj").write_text(f"mtllib {path.name}\nusemtl red\n{OBJ}")
    return read_obj(path.parent / "a.obj")


def _picture(path):
    """A damaged picture goes along as it is, or isn't one."""
    _materials(path)
    (path.parent / "a.mtl").write_text(f"newmtl red\nKd 1 0 0\nmap_Kd {path.name}\n")
    mesh = (path.parent / "a.obj").read_text().replace(f"mtllib {path.name}", "mtllib a.mtl")
    (path.parent / "a.obj").write_text(mesh)
    (material,) = read_obj(path.parent / "a.obj").polygons.materials
    blob = path.read_bytes()
    assert material.texture.data in (blob, None)
    if material.texture.data is None:
        raise FormatError(f"{path}: no picture.")


def _card(path):
    """Weights whose card is damaged; the tensors and their hash are as they were."""
    source = pathlib.Path(sys.modules["physxnet_jax.models"].__file__).parent / "weights/nano"
    folder = path.parent / "weights"
    folder.mkdir(exist_ok=True)
    shutil.copy(source / "weights.safetensors", folder)
    (folder / "card.json").write_bytes(path.read_bytes())
    return load_predictor(folder)


def _tensors(path):
    """Damaged tensors with the hash that belongs to them: only their content is wrong."""
    source = pathlib.Path(sys.modules["physxnet_jax.models"].__file__).parent / "weights/nano"
    folder = path.parent / "weights"
    folder.mkdir(exist_ok=True)
    blob = path.read_bytes()
    (folder / "weights.safetensors").write_bytes(blob)
    card = json.loads((source / "card.json").read_text())
    card["sha256"] = hashlib.sha256(blob).hexdigest()
    (folder / "card.json").write_text(json.dumps(card))
    return load_predictor(folder)


def _weights(name):
    return lambda folder: (
        pathlib.Path(sys.modules["physxnet_jax.models"].__file__).parent / "weights/nano" / name
    ).read_bytes()


def _protocol(name):
    """One of the two tables of a folder of motions, the other one good."""

    def read(path):
        folder = path.parent / "protocol"
        folder.mkdir(exist_ok=True)
        (folder / "ACTIONS.csv").write_bytes(ACTIONS)
        (folder / name).write_bytes(path.read_bytes())
        return read_protocol(folder)

    return read


def _dataset(folder):
    """A dataset of one action with a small sheet."""
    root = folder / "dataset"
    if not root.is_dir():
        sheet = square_sheet(4)
        x = np.asarray(sheet.mesh.vertices)
        open_dataset(root, {"engine": "physxnet"})
        write_garment(root, "top", x, np.asarray(sheet.mesh.faces))
        write_action(root / "walk", load_motion("walk"), "train")
        # A chunk of zeros isn't stored.
        offsets = np.random.default_rng(0).normal(size=(5, *x.shape)).astype(np.float32)
        write_offsets(root / "walk", "top", 0.01 * offsets, {"finite": True})
    return root


def _stored(pattern):
    """A file of the dataset."""
    return lambda folder: next(_dataset(folder).glob(pattern)).read_bytes()


def _dataset_with(pattern):
    def read(path):
        root = _dataset(path.parent)
        target = next(root.glob(pattern))
        good = target.read_bytes()
        target.write_bytes(path.read_bytes())
        try:
            read_note(root)
            return [read_sequence(s) for s in list_sequences(root)]
        finally:
            target.write_bytes(good)

    return read


@dataclasses.dataclass
class _State:
    step: jax.Array
    weights: jax.Array


jax.tree_util.register_dataclass(_State, ["step", "weights"], [])


def _state(step):
    return _State(jnp.int32(step), jnp.arange(6.0))


def _checkpoint(folder):
    """A checkpoint; the good file is the one of its numbers."""
    root = folder / "checkpoints"
    if not root.is_dir():
        kept = Checkpoints(root)
        kept.save(_state(3))
        kept.close()
    return _numbers(root).read_bytes()


def _numbers(root):
    files = [p for p in (root / "3/state").rglob("*") if p.is_file()]
    return max(files, key=lambda p: (p.stat().st_size, p.name))


def _restored(path):
    root = path.parent / "checkpoints"
    target = _numbers(root)
    good = target.read_bytes()
    target.write_bytes(path.read_bytes())
    kept = Checkpoints(root)
    try:
        return kept.latest(_state(0))
    finally:
        kept.close()
        target.write_bytes(good)


def _block(folder):
    """A block of an unfinished clip."""
    arrays = {"positions": np.zeros((4, 5, 3, 1), np.float32), "finite": np.ones((4, 1))}
    Resume(folder / "unfinished", "key").save(0, (jnp.zeros(3), jnp.ones(2)), arrays)
    return (folder / "unfinished/block_00000.npz").read_bytes()


def _resumed(path):
    folder = path.parent / "unfinished"
    (folder / "block_00000.npz").write_bytes(path.read_bytes())
    return list(Resume(folder, "key").blocks((jnp.zeros(3), jnp.ones(2))))


# Name: what a good file holds, its ending, its reader, and how many damages the quick tests try.
READERS = {
    "bvh": (lambda f: BVH.encode(), ".bvh", read_bvh, 20),
    "bvh of a person": (lambda f: _SAMPLES["standing_bvh"]().encode(), ".bvh", load_motion, 20),
    "amc": (lambda f: AMC.encode(), ".amc", _amc, 20),
    "asf": (lambda f: ASF.encode(), ".asf", _asf, 20),
    "motion": (_clip, ".npz", load_motion, 20),
    "obj": (lambda f: OBJ.encode(), ".obj", read_obj, 20),
    "pc2": (_pc2, ".pc2", read_pc2, 20),
    "mdd": (_mdd, ".mdd", read_mdd, 20),
    "scene": (lambda f: SCENE.encode(), ".toml", load_scene, 20),
    "fabric": (lambda f: FABRIC.encode(), ".toml", find_fabric, 20),
    "joint map": (lambda f: NAMES.encode(), ".toml", read_joint_map, 20),
    "gltf": (_gltf, ".gltf", load_motion, 20),
    "amass": (_amass, ".npz", load_motion, 20),
    "character": (_character, ".npz", read_character, 20),
    "usd": (_usda, ".usda", read_character, 20),
    "skin": (_skin, ".gltf", read_character, 20),
    "garment skin": (_skin, ".gltf", read_mesh, 20),
    "garment usd": (_garment_usda, ".usda", read_mesh, 20),
    "binary garment usd": (_garment_usdc, ".usdc", read_mesh, 20),
    "glb": (lambda f: _binary(_gltf(f)), ".glb", load_motion, 20),
    "garment glb": (lambda f: _binary(_skin(f)), ".glb", read_mesh, 20),
    "materials": (lambda f: MTL.encode(), ".mtl", _materials, 20),
    "picture": (_png, ".png", _picture, 20),
    "ply": (lambda f: PLY, ".ply", read_mesh, 20),
    "binary ply": (lambda f: _exported("ply"), ".ply", read_mesh, 20),
    "stl": (lambda f: _exported("stl"), ".stl", read_mesh, 20),
    "card": (_weights("card.json"), ".json", _card, 20),
    "tensors": (_weights("weights.safetensors"), ".safetensors", _tensors, 12),
    "actions": (lambda f: ACTIONS, ".csv", _protocol("ACTIONS.csv"), 20),
    "clips": (lambda f: CLIPS, ".csv", _protocol("CLIPS.csv"), 20),
    "dataset note": (_stored("*.json"), ".json", _dataset_with("*.json"), 20),
    "dataset action": (_stored("walk/*.json"), ".json", _dataset_with("walk/*.json"), 20),
    "dataset motion": (_stored("walk/*.npz"), ".npz", _dataset_with("walk/*.npz"), 20),
    "dataset garment": (_stored("garments/*.npz"), ".npz", _dataset_with("garments/*.npz"), 20),
    "dataset array": (_stored("walk/top/c/0/0/0"), ".bin", _dataset_with("walk/top/c/0/0/0"), 20),
    "dataset description": (
        *(_stored("walk/top/zarr.json"), ".json"),
        *(_dataset_with("walk/top/zarr.json"), 20),
    ),
    "checkpoint": (_checkpoint, ".bin", _restored, 5),
    "resume block": (_block, ".npz", _resumed, 20),
}
NASTY = (
    b'-1 999999999999 1e999 nan inf 0 \xff\xfe \x00 {{{{ }} \n\n .. ../../x / [ ] " 1e308'
    b" 4294967295 18446744073709551615 True None"
).split(b" ")


def damaged(blob: bytes, seed: int) -> bytes:
    """Some bytes changed, cut, doubled, or replaced by what readers stumble over."""
    die = random.Random(seed)
    out = bytearray(blob)
    for _ in range(die.randint(1, 4)):
        at = die.randrange(len(out) + 1)
        kind = die.randrange(6)
        length = die.choice((1, 1, 4, 16, 64))
        if kind == 0:
            out[at : at + length] = die.randbytes(length)
        elif kind == 1:
            del out[at : at + length]
        elif kind == 2:
            out[at:at] = out[at : at + length]
        elif kind == 3:
            out[at:at] = die.choice(NASTY)
        elif kind == 4:
            end = at
            while end < len(out) and out[end : end + 1].strip():
                end += 1
            out[at:end] = die.choice(NASTY)
        elif die.random() < 0.3:
            del out[at:]
    return bytes(out)


def tried(name: str, folder: pathlib.Path, blob: bytes) -> bool:
    """Whether a reader takes it; what it refuses, it refuses by one short sentence."""
    _, suffix, reader, _ = READERS[name]
    path = folder / f"file{suffix}"
    path.write_bytes(blob)
    before = {p.name for p in folder.iterdir()}
    try:
        reader(path)
    except PhysXNetError as error:
        assert len(str(error)) < 1500 and "Traceback" not in str(error)
        return False
    finally:
        new = {p.name for p in folder.iterdir()} - before
        # What the readers above have put beside it.
        beside = {"file.asf", "a.amc", "a.obj", "a.mtl", "weights", "protocol"}
        assert new <= beside, "a reader has written something"
    return True


def main(seconds: float) -> None:
    """Tries all readers in turn until the time is over; names the seed that broke one."""
    end = time.monotonic() + seconds
    count, start = 0, random.SystemRandom().randrange(2**40)
    with tempfile.TemporaryDirectory() as folder:
        root = pathlib.Path(folder)
        goods = {name: READERS[name][0](root) for name in READERS}
        while time.monotonic() < end:
            for name, blob in goods.items():
                try:
                    tried(name, root, damaged(blob, start + count))
                except Exception:
                    print(f"{name}, seed {start + count}")  # noqa: T201
                    raise
            count += 1
    print(f"{count} damages of each of {len(goods)} formats: read or refused")  # noqa: T201


if __name__ == "__main__":
    main(float(sys.argv[1]))
