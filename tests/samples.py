"""Small files that are right, and a measure of clips, for tests of several rooms."""

import numpy as np
import pygltflib

from physxnet_jax.body import NUM_BODY_VERTICES
from physxnet_jax.motion import JOINT_MAPS, LIMBS, clip_transforms

BVH = """HIERARCHY
ROOT Hips
{
  OFFSET 0 0 0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Yrotation Xrotation
  JOINT Knee
  {
    OFFSET 0 -1 0
    CHANNELS 3 Zrotation Yrotation Xrotation
    End Site
    {
      OFFSET 0 -1 0
    }
  }
}
MOTION
Frames: 2
Frame Time: 0.0083333
0 1 0 0 0 0 0 0 0
0 1 0 0 0 90 10 0 0
"""
ASF = """:version 1.10
:units
  mass 1.0
  length 0.45
  angle deg
:root
  order TX TY TZ RX RY RZ
  axis XYZ
  position 0 0 0
  orientation 0 0 0
:bonedata
  begin
    id 1
    name lfemur
    direction 0 -1 0
    length 2
    axis 0 0 20 XYZ
    dof rx
  end
:hierarchy
  begin
    root lfemur
  end
"""
AMC = ":FULLY-SPECIFIED\n:DEGREES\n1\nroot 0 1 0 0 0 0\nlfemur 10\n2\nroot 0 1 0 0 0 0\nlfemur 20\n"

LEGS = [f"{s}{b}" for s in ("Left", "Right") for b in ("Leg", "Foot")]
FIGURE = {
    "Hips": (None, (0, 1, 0)),
    "Spine": ("Hips", (0, 0.2, 0)),
    **{f"{s}UpLeg": ("Hips", (x, 0, 0)) for s, x in (("Left", 0.1), ("Right", -0.1))},
    **{b: (b.replace("Foot", "Leg") if "Foot" in b else b.replace("Leg", "UpLeg"), (0, -0.4, 0))
       for b in LEGS},
    **{f"{s}Arm": ("Spine", (x, 0.3, 0)) for s, x in (("Left", 0.2), ("Right", -0.2))},
    **{f"{s}{b}": (f"{s}{a}", (x, 0, 0)) for s, x in (("Left", 0.25), ("Right", -0.25))
       for a, b in (("Arm", "ForeArm"), ("ForeArm", "Hand"))},
}  # fmt: skip


def standing_bvh(offsets=None, root=(0, 1, 0), legs=None):
    """Three frames of a standing figure; `legs` moves the joints of its legs in the clip."""
    lines, order = ["HIERARCHY"], []

    def add(name):
        order.append(name)
        parent, place = FIGURE[name]
        place = (offsets or {}).get(name, place)
        moves = parent is None or (legs is not None and name in LEGS)
        channels = ["Xposition", "Yposition", "Zposition"] * moves
        channels += ["Zrotation", "Yrotation", "Xrotation"]
        lines.append(
            f"{'JOINT' if parent else 'ROOT'} {name}\n{{\nOFFSET {' '.join(map(str, place))}"
        )
        lines.append(f"CHANNELS {len(channels)} {' '.join(channels)}")
        for child, (above, _) in FIGURE.items():
            if above == name:
                add(child)
        lines.append("}")

    add("Hips")
    row = []
    for name in order:
        row += (
            [*root] if name == "Hips" else [0, legs, 0] if legs is not None and name in LEGS else []
        )
        row += [0, 0, 0]
    lines.append("MOTION\nFrames: 3\nFrame Time: 0.0333333")
    return "\n".join([*lines, *3 * [" ".join(map(str, row))]]) + "\n"


def limbs_apart(body, rest, a, b):
    """Largest angle between limbs of two clips [degrees]."""
    at = []
    for motion in (a, b):
        world, shift = (np.asarray(x) for x in clip_transforms(body, rest, motion))
        heads = np.asarray(body.joint_positions(rest)[0])
        at.append(np.einsum("fjab,jb->fja", world, heads) + shift)
    worst = 0.0
    for p, q in LIMBS.items():
        d, e = (x[:, body.joint(q)] - x[:, body.joint(p)] for x in at)
        cosine = (d * e).sum(1) / np.linalg.norm(d, axis=1) / np.linalg.norm(e, axis=1)
        worst = max(worst, float(np.degrees(np.arccos(np.clip(cosine, -1, 1))).max()))
    return worst


def rigged_person(path, body, shape=None, *, unit=0.01, family="vrm"):
    """The body's own mesh and skin in its bind pose, as a rig of somebody else's names.

    No animation: he stands as he was bound, his joints' axes the world's.
    """
    shape = body.default_shape() if shape is None else shape
    heads = np.asarray(body.joint_positions(body.rest_vertices(shape))[0], np.float64)
    rest = np.asarray(body.rest_vertices(shape))
    names = JOINT_MAPS[family]
    g = pygltflib.GLTF2(scene=0, scenes=[pygltflib.Scene(nodes=[0, 1])])
    blob = bytearray()

    def put(values, kind, component=5126):
        raw = np.ascontiguousarray(values).tobytes()
        g.bufferViews.append(
            pygltflib.BufferView(buffer=0, byteOffset=len(blob), byteLength=len(raw))
        )
        g.accessors.append(
            pygltflib.Accessor(
                bufferView=len(g.bufferViews) - 1,
                componentType=component,
                count=len(values),
                type=kind,
            )
        )
        blob.extend(raw)
        return len(g.accessors) - 1

    g.nodes = [pygltflib.Node(name="Armature", scale=[unit] * 3, children=[2])]
    g.nodes.append(pygltflib.Node(name="Figure", mesh=0, skin=0))
    for j, (name, parent) in enumerate(zip(body.joint_names, body.parents, strict=True)):
        offset = heads[j] - (heads[parent] if parent >= 0 else 0.0)
        kids = [k + 2 for k, p in enumerate(body.parents) if p == j]
        own = names.get(name, f"extra_{name}")
        g.nodes.append(
            pygltflib.Node(name=own, children=kids, translation=(offset / unit).tolist())
        )
    joints = len(body.parents)
    binds = np.tile(np.eye(4), (joints, 1, 1))
    binds[:, :3, :3] /= unit
    binds[:, :3, 3] = -heads / unit
    weights = np.asarray(body.weights)[:NUM_BODY_VERTICES]
    most = np.argsort(-weights, axis=1, kind="stable")[:, :8]
    share = np.take_along_axis(weights, most, axis=1)
    sets = {}
    for k in range(2):
        part = slice(4 * k, 4 * k + 4)
        sets[f"JOINTS_{k}"] = put(most[:, part].astype(np.uint8), "VEC4", 5121)
        sets[f"WEIGHTS_{k}"] = put(share[:, part].astype(np.float32), "VEC4")
    attributes = pygltflib.Attributes(POSITION=put(rest[:NUM_BODY_VERTICES], "VEC3"), **sets)
    faces = np.asarray(body.rest_mesh().faces).astype(np.uint32).ravel()
    primitive = pygltflib.Primitive(attributes=attributes, indices=put(faces, "SCALAR", 5125))
    g.meshes = [pygltflib.Mesh(primitives=[primitive])]
    g.skins = [
        pygltflib.Skin(
            joints=list(range(2, joints + 2)),
            inverseBindMatrices=put(binds.transpose(0, 2, 1).astype(np.float32), "MAT4"),
        )
    ]
    g.buffers.append(pygltflib.Buffer(byteLength=len(blob)))
    g.set_binary_blob(bytes(blob))
    g.save_binary(str(path))
    return path


def sheet(n, step=0.01):
    """Vertices [m] and triangles of a flat square of n x n vertices."""
    y, x = np.mgrid[:n, :n] * step
    v = np.column_stack([x.ravel(), y.ravel(), np.zeros(n * n)])
    i = np.arange(n * n).reshape(n, n)
    a, b, c, d = (q.ravel() for q in (i[:-1, :-1], i[:-1, 1:], i[1:, :-1], i[1:, 1:]))
    return v, np.concatenate([np.column_stack([a, b, c]), np.column_stack([b, d, c])])
