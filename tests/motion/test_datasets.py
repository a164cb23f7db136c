"""Motions under the names of other datasets, up axes, and skeletons with joints without keys."""

import pathlib
import pickle
import runpy

import numpy as np
import pygltflib
import pytest
from scipy.spatial.transform import Rotation

from physxnet_jax.errors import MotionError
from physxnet_jax.motion import load_motion, procedural_clip

_GLTF = runpy.run_path(str(pathlib.Path(__file__).parent / "test_gltf_motion.py"))
write_gltf, amass, limbs_apart = (_GLTF[n] for n in ("write_gltf", "amass", "limbs_apart"))
standing_bvh = runpy.run_path(str(pathlib.Path(__file__).parents[1] / "samples.py"))["standing_bvh"]


@pytest.fixture(scope="module")
def walk():
    return procedural_clip("walk", fps=30.0)[:12]


@pytest.fixture(scope="module")
def poses(body, rest, walk):
    """Rotation vectors [frames, 24, 3] and places [frames, 3], Y up."""
    arrays = amass(body, rest, walk, "poses", False)
    return arrays["poses"][:, :72].reshape(-1, 24, 3), arrays["trans"]


def _aist(poses, trans):
    return {"smpl_poses": poses.reshape(-1, 72), "smpl_trans": 93.0 * trans, "smpl_scaling": 93.0}


def _matrices(poses):
    return Rotation.from_rotvec(poses.reshape(-1, 3)).as_matrix().reshape(*poses.shape, 3)


def _from_camera(poses):
    """The same poses as a camera sees them, whose Y axis points down."""
    out = poses.copy()
    down = Rotation.from_euler("X", 180, degrees=True)
    out[:, 0] = (down * Rotation.from_rotvec(poses[:, 0])).as_rotvec()
    return out


LAYOUTS = {
    "AIST++": lambda p, t: (_aist(p, t), 60.0),
    "AIST++ in rows": lambda p, t: ({**_aist(p, t), "smpl_poses": p}, 60.0),
    "24 joints": lambda p, t: ({"poses": p, "trans": t, "fps": 30.0}, 30.0),
    "matrices": lambda p, t: ({"poses": _matrices(p), "trans": t, "fps": 30.0}, 30.0),
    "4D-Humans": lambda p, t: (
        {"global_orient": _matrices(p[:, :1]), "body_pose": _matrices(p[:, 1:])},
        30.0,
    ),
    "4D-Humans, camera": lambda p, t: (
        {
            "global_orient": _matrices(_from_camera(p)[:, :1]),
            "body_pose": _matrices(p[:, 1:]),
            "transl": t * [1, -1, -1],
        },
        30.0,
    ),
    "vectors": lambda p, t: (
        {"global_orient": p[:, 0], "body_pose": p[:, 1:].reshape(len(p), -1), "transl": t},
        30.0,
    ),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_names_and_shapes_of_datasets_are_read(body, rest, walk, poses, tmp_path, layout):
    arrays, fps = LAYOUTS[layout](*poses)
    path = tmp_path / "clip.npz"
    np.savez(path, **arrays)
    clip = load_motion(path)
    assert clip.fps == fps and clip.num_frames == 12
    assert limbs_apart(body, rest, walk, clip) < 0.2


def test_pickled_datasets_are_read_and_code_in_them_is_not_run(body, rest, walk, poses, tmp_path):
    path = tmp_path / "gBR.pkl"
    for protocol in (2, pickle.HIGHEST_PROTOCOL):
        path.write_bytes(pickle.dumps(_aist(*poses) | {"smpl_loss": 1.0}, protocol=protocol))
        assert limbs_apart(body, rest, walk, load_motion(path, source_fps=30.0)) < 0.2

    class Evil:
        def __reduce__(self):
            return pathlib.Path.touch, (tmp_path / "ran",)

    for bad in ({"smpl_poses": Evil()}, Evil(), [1], {"smpl_poses": np.array([None])}):
        path.write_bytes(pickle.dumps(bad))
        with pytest.raises(MotionError, match="not a motion archive"):
            load_motion(path)
    path.write_bytes(pickle.dumps(_aist(*poses))[:-20])
    with pytest.raises(MotionError, match="not a motion archive"):
        load_motion(path)
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"smpl_scaling": 0.0}, "smpl_scaling is 0"),
        ({"smpl_trans": np.zeros((3, 3))}, "trans"),
        ({"smpl_trans": np.full((12, 3), "a")}, "smpl_trans"),
        ({"smpl_poses": np.zeros((12, 5, 3, 3))}, "poses"),
        ({"smpl_poses": np.zeros((12, 9))}, "poses"),
    ],
)
def test_broken_dataset_files_are_refused(poses, tmp_path, change, says):
    path = tmp_path / "clip.npz"
    np.savez(path, **(_aist(*poses) | change))
    with pytest.raises(MotionError, match=says):
        load_motion(path)
    np.savez(path, body_pose=np.zeros((4, 23, 3, 3)))
    with pytest.raises(MotionError, match="global_orient"):
        load_motion(path)
    np.savez(path, body_pose=np.zeros((4, 23, 3, 3)), global_orient=np.zeros((4, 1, 3, 3)))
    with pytest.raises(MotionError, match="rotation matrices"):
        load_motion(path)


# Arms that hang, so that no frame is taken for a T-pose.
ARMS = {f"{s}{b}": (0, -0.25, 0) for s in ("Left", "Right") for b in ("ForeArm", "Hand")}


def _lying(z_up):
    """A person who lies on the back throughout, in a BVH with Y or Z up."""
    turn = Rotation.from_euler("X", -90, degrees=True)
    if z_up:
        turn = Rotation.from_euler("X", 90, degrees=True) * turn
    z, y, x = turn.as_euler("ZYX", degrees=True)
    text = standing_bvh(root=(0, 0, 0.2) if z_up else (0, 0.2, 0), offsets=ARMS)
    head, rows = text.split("Frame Time: 0.0333333\n")
    out = []
    for row in rows.split("\n"):
        words = row.split()
        if words:
            words[3:6] = (f"{v:.6f}" for v in (z, y, x))
            out.append(" ".join(words))
    return head + "Frame Time: 0.0333333\n" + "\n".join(out) + "\n"


def test_a_stated_up_axis_counts(body, rest, tmp_path):
    lying, other = tmp_path / "lying.bvh", tmp_path / "lying_z.bvh"
    lying.write_text(_lying(False))
    other.write_text(_lying(True))
    plain, stated = load_motion(lying), load_motion(other, up="z")
    assert limbs_apart(body, rest, plain, stated) < 0.01
    assert limbs_apart(body, rest, load_motion(lying, up="y"), plain) < 0.01
    # The control: unstated, a person who stands at rest along Y stands in the Z-up file.
    assert limbs_apart(body, rest, plain, load_motion(other)) > 60.0
    with pytest.raises(MotionError, match="up is the axis of a file"):
        load_motion("walk", up="z")


def test_a_stated_up_axis_counts_in_poses_of_smpl(body, rest, walk, tmp_path):
    path = tmp_path / "walk.npz"
    np.savez(path, **amass(body, rest, walk, "poses", True))
    assert limbs_apart(body, rest, walk, load_motion(path, up="z")) < 0.2
    assert limbs_apart(body, rest, walk, load_motion(path, up="y")) > 60.0


def test_joints_without_keys_stay_at_rest(body, rest, walk, tmp_path):
    path = write_gltf(tmp_path / "walk.glb", body, rest, walk)
    document = pygltflib.GLTF2().load(str(path))
    document.skins = []
    for node in document.nodes:
        node.skin = None
    whole = document.animations[0].channels
    hands = {k for k, n in enumerate(document.nodes) if n.name.endswith(("Hand", "Foot"))}
    document.animations[0].channels = [c for c in whole if c.target.node not in hands]
    assert len(document.animations[0].channels) < len(whole)
    document.save_binary(str(tmp_path / "few.glb"))
    assert limbs_apart(body, rest, walk, load_motion(tmp_path / "few.glb")) < 0.3


def test_compressed_meshes_do_not_block_a_motion(body, rest, walk, tmp_path):
    path = write_gltf(tmp_path / "walk.glb", body, rest, walk)
    document = pygltflib.GLTF2().load(str(path))
    document.extensionsRequired = document.extensionsUsed = ["KHR_draco_mesh_compression"]
    document.accessors.append(pygltflib.Accessor(componentType=5126, count=3, type="VEC3"))
    primitive = pygltflib.Primitive(
        attributes=pygltflib.Attributes(POSITION=len(document.accessors) - 1)
    )
    document.meshes = [pygltflib.Mesh(primitives=[primitive])]
    document.nodes.append(pygltflib.Node(name="skin", mesh=0))
    document.scenes[0].nodes.append(len(document.nodes) - 1)
    document.save_binary(str(tmp_path / "draco.glb"))
    assert limbs_apart(body, rest, walk, load_motion(tmp_path / "draco.glb")) < 0.2
    from physxnet_jax.dressing import read_character

    with pytest.raises(MotionError, match=r"KHR_draco_mesh_compression.*gltf-transform"):
        read_character(tmp_path / "draco.glb")
