"""A rig of somebody else's moved by a motion of the body's."""

import pathlib
import runpy

import numpy as np
import pygltflib
import pytest
from scipy.spatial.transform import Rotation

from physxnet_jax.errors import MotionError
from physxnet_jax.io import GltfFile
from physxnet_jax.motion import load_motion, procedural_clip, retarget_to_rig

_GLTF = runpy.run_path(str(pathlib.Path(__file__).parent / "test_gltf_motion.py"))
write_gltf, as_vrm, limbs_apart = (_GLTF[n] for n in ("write_gltf", "as_vrm", "limbs_apart"))


@pytest.fixture(scope="module")
def walk():
    return procedural_clip("walk", fps=15.0)


def matrices(file):
    """What the file's own animation does, unscaled."""
    return file.world(file.frame_times()[0])


def turned(path, out, turn):
    """The same rig, facing another way at rest, its animation too."""
    document = pygltflib.GLTF2().load(str(path))
    node = document.nodes[0]
    node.rotation = (turn * Rotation.from_quat(node.rotation)).as_quat().tolist()
    document.save_binary(str(out))
    return out


@pytest.mark.parametrize("scale", [0.01, 1.0])
def test_retargeted_motion_matches_the_animation_of_the_rig(body, rest, tmp_path, walk, scale):
    file = GltfFile(write_gltf(tmp_path / "walk.glb", body, rest, walk, scale=scale))
    own, driven = matrices(file), retarget_to_rig(file, walk)
    np.testing.assert_allclose(driven[:, 1:, :3, 3], own[:, 1:, :3, 3], atol=2e-3)
    np.testing.assert_allclose(driven[:, 1:, :3, :3], own[:, 1:, :3, :3], atol=0.02 * scale)
    # The control: at rest he doesn't walk.
    still = np.broadcast_to(file.world(), own.shape)
    assert np.abs(still[..., :3, 3] - own[..., :3, 3]).max() > 0.2


@pytest.mark.parametrize("angle", [180.0, 90.0])
def test_rest_heading_of_a_rig_does_not_change_the_motion(body, rest, tmp_path, walk, angle):
    plain = write_gltf(tmp_path / "walk.glb", body, rest, walk)
    turn = Rotation.from_euler("Y", angle, degrees=True)
    path = turned(plain, tmp_path / "turned.glb", turn)
    own, driven = matrices(GltfFile(plain)), retarget_to_rig(GltfFile(path), walk)
    np.testing.assert_allclose(driven[:, 1:, :3, 3], own[:, 1:, :3, 3], atol=0.02)


def test_vrm_rigs_are_retargeted_and_root_motion_scales_with_leg_length(body, rest, tmp_path, walk):
    plain = write_gltf(tmp_path / "walk.glb", body, rest, walk)
    vrm = as_vrm(plain, "VRMC_vrm", tmp_path / "a.vrm")
    own = retarget_to_rig(GltfFile(plain), walk)
    np.testing.assert_allclose(retarget_to_rig(GltfFile(vrm), walk), own, atol=1e-6)
    document = pygltflib.GLTF2().load(str(plain))
    document.nodes[0].scale = [0.02] * 3
    document.save_binary(str(plain))
    twice = retarget_to_rig(GltfFile(plain), walk)
    np.testing.assert_allclose(twice[:, 1:, :3, 3], 2.0 * own[:, 1:, :3, 3], atol=1e-3)


def test_retargeting_round_trips_through_gltf(body, rest, tmp_path, walk):
    """A rig driven by one clip, its frames written as an animation and read again."""
    path = write_gltf(tmp_path / "walk.glb", body, rest, walk)
    punch = procedural_clip("punch", fps=15.0)
    again = load_motion(write_gltf(tmp_path / "punch.glb", body, rest, punch))
    own = matrices(GltfFile(tmp_path / "punch.glb"))
    driven = retarget_to_rig(GltfFile(path), again)
    np.testing.assert_allclose(driven[:, 1:, :3, 3], own[:, 1:, :3, 3], atol=0.02)


def test_rigs_without_a_skeleton_or_known_joints_are_refused(body, rest, tmp_path, walk):
    path = write_gltf(tmp_path / "walk.glb", body, rest, walk)
    document = pygltflib.GLTF2().load(str(path))
    for n, node in enumerate(document.nodes):
        node.name = f"bone{n}"
    document.save_binary(str(path))
    with pytest.raises(MotionError, match=r"unknown joints.*bone3"):
        retarget_to_rig(GltfFile(path), walk)
    document.skins, document.animations = [], []
    document.save_binary(str(path))
    with pytest.raises(MotionError, match="no skeleton"):
        retarget_to_rig(GltfFile(path), walk)
