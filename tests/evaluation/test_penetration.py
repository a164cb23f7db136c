"""Penetration measured on meshes: right at rest, and it sees what was pushed in."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import KDTree

from physxnet_jax.body import NUM_BODY_VERTICES
from physxnet_jax.evaluation import edge_strain, penetration
from physxnet_jax.garment import template
from physxnet_jax.geometry import vertex_normals
from physxnet_jax.motion import Motion, animate
from physxnet_jax.simulation import Scene, prepare_scene
from physxnet_jax.simulation.effects import Gravity


@pytest.fixture(scope="module")
def standing(body, rest):
    root = body.joint_positions(rest)[0][:1]
    return Motion(body.a_pose()[None], root, 30.0)


@pytest.mark.release
@pytest.mark.parametrize("name", ["top", "bottom"])
def test_rest_cloth_is_outside_and_sunken_cloth_is_inside(body, rest, standing, name):
    assembly = prepare_scene(Scene((template(name),), (Gravity(),))).assembly
    x = assembly.rest[None].astype(np.float32)
    seen = penetration(assembly, standing, x)
    assert seen.cloth_inside.mean() == 0 and seen.skin_outside[0] == 0
    # A patch that lies on the skin, pushed inwards by 15 mm, ends up about 10 mm deep.
    near = KDTree(assembly.rest_body[:NUM_BODY_VERTICES]).query(assembly.rest)[0]
    centre = assembly.rest[near.argmin()]
    front = np.flatnonzero(np.linalg.norm(assembly.rest - centre, axis=1) < 0.04)
    pushed = x.copy()
    n = np.asarray(vertex_normals(jnp.asarray(x[0]), jnp.asarray(assembly.faces)))
    pushed[0, front] -= 0.015 * n[front]
    seen = penetration(assembly, standing, pushed)
    assert seen.cloth_inside[0, front].mean() > 0.5
    assert not np.delete(seen.cloth_inside[0], front).any()
    assert 0.005 < seen.depth.max() < 0.015
    assert not seen.pinched.any(), "there is room above the skin"
    assert seen.skin_outside[0] > 0, "and the skin there sticks out"


def test_edge_strain_of_a_scaled_garment_is_exact():
    assembly = prepare_scene(Scene((template("bottom"),), (Gravity(),))).assembly
    x = np.stack([assembly.rest, 1.1 * assembly.rest])
    strain = edge_strain(assembly, x)
    np.testing.assert_allclose(strain[0], 0.0, atol=1e-12)
    np.testing.assert_allclose(strain[1], 0.1, rtol=1e-9)


@pytest.mark.release
def test_penetration_is_measured_at_selected_frames(standing):
    assembly = prepare_scene(Scene((template("bottom"),), (Gravity(),))).assembly
    motion = Motion(
        jnp.repeat(standing.rotations, 3, axis=0), jnp.repeat(standing.root, 3, axis=0), 30.0
    )
    x = np.repeat(assembly.rest[None].astype(np.float32), 3, axis=0)
    chosen = penetration(assembly, motion, x, frames=np.asarray([0, 2]))
    assert chosen.depth.shape[0] == 2 and np.isfinite(chosen.skin_outside).all()
    some = penetration(assembly, motion, x, frames=np.asarray([0]), bare_skin=False)
    np.testing.assert_array_equal(some.cloth_inside[0], chosen.cloth_inside[0])
    assert np.isnan(some.skin_outside).all()


@pytest.mark.release
def test_cloth_inside_another_limb_is_pinched(body, rest):
    """An arm pressed into the flank: both limbs' cloth is above its own skin, yet inside."""
    g = template("top")
    assembly = prepare_scene(Scene((g,), (Gravity(),))).assembly
    root = body.joint_positions(rest)[0][:1]
    found = []
    for angle in (60.0, -60.0):  # outwards, inwards
        half = np.radians(angle) / 2
        pose = np.asarray(body.a_pose()).copy()
        pose[body.joint("LeftArm")] = [np.cos(half), 0.0, 0.0, np.sin(half)]
        motion = Motion(jnp.asarray(pose[None], jnp.float32), root, 30.0)
        x = np.asarray(animate(body, rest, g.rest_vertices(rest), g.skin, motion))
        found.append(penetration(assembly, motion, x, bare_skin=False))
    away, pressed = found
    assert not away.cloth_inside.any() and not away.pinched.any()
    assert pressed.cloth_inside.mean() > 0.07 and pressed.depth.max() > 0.05
    assert pressed.pinched[pressed.cloth_inside].mean() > 0.9
