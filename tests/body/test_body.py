"""The body against an independent NumPy evaluation, its invariances and gradients."""

import functools
import importlib.resources

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.spatial.transform import Rotation

from physxnet_jax.body import (
    NUM_BODY_VERTICES,
    bone_directions,
    forward_kinematics,
    load_body,
    t_pose,
)
from physxnet_jax.errors import PhysXNetError
from physxnet_jax.garment import template
from physxnet_jax.geometry import manifold_report
from physxnet_jax.uv._atlas import _cached_atlas


def numpy_body(shape, quaternions, root):
    """The body evaluated joint by joint and vertex by vertex, straight from the asset."""
    path = importlib.resources.files("physxnet_jax.body") / "assets" / "makehuman_cc0.npz"
    with importlib.resources.as_file(path) as file, np.load(file) as data:
        a = {k: data[k] for k in data.files}
    q = float(a["quantum"])
    base = a["bases"][0] * q + shape[0] * (a["bases"][1] - a["bases"][0]) * q
    for k, s in enumerate(shape[1:]):
        female, male = a["deltas"][0, k] * q, a["deltas"][1, k] * q
        base = base + s * (female + shape[0] * (male - female))
    heads = [base[rows].mean(axis=0) for rows in a["joint_rows"][:, 0]]
    world, place = [], []
    for j, parent in enumerate(a["parents"]):
        local = Rotation.from_quat(quaternions[j], scalar_first=True).as_matrix()
        if parent < 0:
            world.append(local)
            place.append(np.asarray(root, float))
        else:
            world.append(world[parent] @ local)
            place.append(place[parent] + world[parent] @ (heads[j] - heads[parent]))
    out = np.zeros((NUM_BODY_VERTICES, 3))
    weights = a["weights"].astype(float)
    weights /= weights.sum(axis=1, keepdims=True)
    for j in range(len(world)):
        share = np.where(a["weight_joints"] == j, weights, 0).sum(axis=1)[:NUM_BODY_VERTICES]
        moved = (base[:NUM_BODY_VERTICES] - heads[j]) @ world[j].T + place[j]
        out += share[:, None] * moved
    return out


def test_vertices_match_numpy_within_ten_micrometres(body):
    rng = np.random.default_rng(0)
    for _ in range(3):
        shape = rng.uniform(0, 1, len(body.shape_names)).astype(np.float32)
        pose = Rotation.from_rotvec(rng.normal(0, 0.4, (31, 3))).as_quat(scalar_first=True)
        root = rng.normal(0, 1, 3)
        ours = jax.jit(body.__call__)(
            jnp.asarray(shape), jnp.asarray(pose, jnp.float32), jnp.asarray(root, jnp.float32)
        )
        np.testing.assert_allclose(np.asarray(ours), numpy_body(shape, pose, root), atol=1e-5)


def test_mesh_is_the_closed_base_mesh(body):
    mesh = body.rest_mesh()
    assert mesh.vertices.shape == (13380, 3) and mesh.faces.shape == (26756, 3)
    report = manifold_report(np.asarray(mesh.faces))
    assert report["boundary_edges"] == report["non_manifold_edges"] == 0
    height = np.ptp(np.asarray(mesh.vertices)[:, 1])
    assert height == pytest.approx(1.605, abs=0.005)
    male = np.asarray(body.rest_mesh(body.shape(gender=1.0)).vertices)
    assert np.ptp(male[:, 1]) == pytest.approx(1.748, abs=0.005)
    assert len(body.shape_names) >= 9


def test_t_pose_has_level_arms_and_straight_legs(body):
    rest = body.rest_vertices(body.default_shape())
    world, _ = body.transforms(rest, t_pose(body), jnp.zeros(3))
    pointing = np.einsum("jab,jb->ja", np.asarray(world), bone_directions(body))
    for side, sign in (("Left", 1), ("Right", -1)):
        for bone in ("Arm", "ForeArm"):
            assert pointing[body.joint(side + bone), 0] * sign > 0.9999
        for bone in ("UpLeg", "Leg"):
            assert pointing[body.joint(side + bone), 1] < -0.9999
    a_pose = body(body.default_shape(), body.a_pose(), body.joint_positions(rest)[0][0])
    np.testing.assert_allclose(np.asarray(a_pose), np.asarray(rest[:13380]), atol=2e-6)


def test_rigid_root_motion_moves_all_vertices_rigidly(body):
    turn = Rotation.from_rotvec([0.3, 1.2, -0.4])
    pose = t_pose(body)
    turned = pose.at[0].set(jnp.asarray(turn.as_quat(scalar_first=True), jnp.float32))
    shape = body.default_shape()
    a = np.asarray(body(shape, pose, jnp.zeros(3)))
    b = np.asarray(body(shape, turned, jnp.array([1.0, 2.0, 3.0])))
    np.testing.assert_allclose(b, a @ turn.as_matrix().T + [1, 2, 3], atol=3e-6)


@pytest.mark.release
def test_vmap_matches_a_loop_and_gradients_match_finite_differences(body):
    rng = np.random.default_rng(1)
    poses = Rotation.from_rotvec(rng.normal(0, 0.3, (3 * 31, 3))).as_quat(scalar_first=True)
    poses = jnp.asarray(poses.reshape(3, 31, 4), jnp.float32)
    shape, root = body.default_shape(), jnp.zeros(3)
    batch = jax.vmap(lambda p: body(shape, p, root))(poses)
    one = jnp.stack([body(shape, p, root) for p in poses])
    np.testing.assert_allclose(np.asarray(batch), np.asarray(one), atol=1e-6)

    @jax.jit
    def lift(s, p):
        return jnp.mean(body(s, p, root)[:, 1] ** 2)

    gs, gp = jax.grad(lift, argnums=(0, 1))(shape + 0.2, poses[0])
    step = 1e-2
    for k in (0, 1, 5):
        d = jnp.zeros_like(shape).at[k].set(step)
        slope = (lift(shape + 0.2 + d, poses[0]) - lift(shape + 0.2 - d, poses[0])) / (2 * step)
        assert float(gs[k]) == pytest.approx(float(slope), rel=0.02, abs=1e-5)
    assert bool(jnp.isfinite(gp).all()) and float(jnp.abs(gp).max()) > 0


def by_hand(parents, heads, pose, root):
    world, place = [], []
    for j, parent in enumerate(parents):
        local = Rotation.from_quat(pose[j], scalar_first=True).as_matrix()
        world.append(local if parent < 0 else world[parent] @ local)
        reach = None if parent < 0 else world[parent] @ (heads[j] - heads[parent])
        place.append(np.asarray(root) if parent < 0 else place[parent] + reach)
    world = np.stack(world)
    return world, np.stack(place) - np.einsum("jab,jb->ja", world, heads)


@pytest.mark.parametrize(
    "parents",
    [(-1,), (-1, 0, 1, 2), (-1, 0, 0, 0), (-1, 0, -1, 2, 1, 0), (-1, 0, 1, 1, 0, 4, 5, 2)],
    ids=["one", "chain", "star", "two roots", "tree"],
)
def test_forward_kinematics_match_numpy_for_any_joint_tree(parents):
    rng = np.random.default_rng(len(parents))
    heads = rng.normal(size=(len(parents), 3)).astype(np.float32)
    pose = rng.normal(size=(len(parents), 4)).astype(np.float32)
    root = rng.normal(size=3).astype(np.float32)
    want = by_hand(parents, heads, pose, root)
    args = jnp.asarray(heads), jnp.asarray(pose), jnp.asarray(root)
    follow = jax.jit(functools.partial(forward_kinematics, parents))
    for a, b in zip(follow(*args), want, strict=True):
        np.testing.assert_allclose(np.asarray(a), b, atol=1e-5)

    @jax.jit
    def total(*args):
        world, shift = follow(*map(jnp.asarray, args))
        return jnp.sum(jnp.sin(world)) + jnp.sum(jnp.sin(shift))

    check_grads(total, args, order=1, modes=["fwd", "rev"], eps=1e-2, atol=0.05, rtol=0.05)


def test_unknown_shape_parameters_are_refused(body):
    with pytest.raises(PhysXNetError, match="weight_up"):
        body.shape(wieght_up=1.0)


def test_assets_first_loaded_under_jit_contain_no_tracers(rest):
    """Kept by a cache: what belonged to one program would break every other."""
    kept = []

    @jax.jit
    def inside(x):
        kept.extend([load_body.__wrapped__(), template.__wrapped__("top")])
        kept.append(_cached_atlas.__wrapped__(32, 32, True))
        kept.append(jnp.zeros(3))
        return x

    inside(jnp.ones(()))
    leaves = jax.tree.leaves(kept[:-1])
    assert len(leaves) > 20 and not any(isinstance(x, jax.core.Tracer) for x in leaves)
    body = kept[0]
    np.testing.assert_array_equal(body.rest_vertices(body.default_shape()), rest)
    # The control: what is made there otherwise does.
    assert isinstance(kept[-1], jax.core.Tracer)
