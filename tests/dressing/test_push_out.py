"""The last push-out: what is inside comes out on its own side, the rest stays."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import KDTree

from physxnet_jax.dressing import (
    make_patch,
    push_out,
    skin_height,
    tuck_in,
    unbound_wearable,
)
from physxnet_jax.dressing._push_out import _off_skin, _posed, faces_at_rest, faces_near
from physxnet_jax.dressing._skirt import skin_foot
from physxnet_jax.garment import template
from physxnet_jax.geometry import TriMesh, closest_points, each_frame, mesh_edges
from physxnet_jax.models import skin_wearable
from physxnet_jax.motion import clip_transforms, load_motion


@pytest.fixture(scope="module")
def balance(body, rest):
    motion = load_motion("balance", fps=30.0)
    return tuple(jnp.asarray(x[0]) for x in clip_transforms(body, rest, motion))


@pytest.fixture(scope="module")
def stride(body, rest):
    """The frame of the walk in which the feet are farthest apart."""
    world, shift = clip_transforms(body, rest, load_motion("walk", fps=30.0))
    heads = np.asarray(rest)[np.asarray(body.joint_rows)].mean(axis=2)[:, 0]
    left, right = (body.joint(f"{s}Foot") for s in ("Left", "Right"))
    feet = [np.asarray(world)[:, j] @ heads[j] + np.asarray(shift)[:, j] for j in (left, right)]
    frame = int(np.argmax(np.linalg.norm(feet[0] - feet[1], axis=1)))
    return jnp.asarray(world[frame]), jnp.asarray(shift[frame])


def fitted(body, rest, name):
    g = template(name)
    wearable = unbound_wearable(body, rest, g)
    return wearable, make_patch(body, rest, wearable, g.mesh)


def test_what_is_inside_is_lifted_and_nothing_else_is_touched(body, rest, balance):
    wearable, patch = fitted(body, rest, "bottom")
    x = skin_wearable(wearable, *balance)
    height = skin_height(patch, x, *balance)[0]
    clear = np.asarray(height > patch.least + 1e-4)
    assert clear.any() and not clear.all()
    same = push_out(patch, x, *balance)
    np.testing.assert_array_equal(np.asarray(same)[clear], np.asarray(x)[clear])
    # With a wanted height of a metre, the way is the skin's normal.
    tall = dataclasses.replace(patch, least=jnp.ones_like(patch.least))
    way = skin_height(tall, x, *balance)[1]
    sunk = x - (height + 0.01)[:, None] * way / jnp.linalg.norm(way, axis=1, keepdims=True)
    assert float(jnp.mean(skin_height(patch, sunk, *balance)[0])) < -0.005
    lifted = push_out(patch, sunk, *balance)
    after = np.asarray(skin_height(patch, lifted, *balance)[0])
    assert np.mean(after > -1e-3) > 0.97


@pytest.mark.parametrize("name", ["top", "bottom"])
def test_the_skin_next_to_cloth_is_found_where_the_cloth_is(body, rest, name):
    """A knee drawn up, the back bent, an arm laid on."""
    wearable, patch = fitted(body, rest, name)
    q = jnp.zeros((31, 4)).at[:, 0].set(1.0)
    for joint, axis, angle in (
        ("LeftUpLeg", 0, -2.0),
        ("LeftLeg", 0, 2.2),
        ("LowerBack", 0, 0.6),
        ("RightArm", 2, 0.7),
    ):
        half = 0.5 * angle
        turned = jnp.zeros(4).at[0].set(np.cos(half)).at[1 + axis].set(np.sin(half))
        q = q.at[body.joint(joint)].set(turned)
    r, t = body.transforms(rest, q, jnp.zeros(3))
    # Cloth that a network left up to some centimetres beside its place.
    x = skin_wearable(wearable, r, t)
    x = x + 0.03 * jax.random.normal(jax.random.key(0), x.shape)
    skin, normals = _posed(patch, r, t)
    whole = closest_points(TriMesh(skin, patch.faces), x)
    feet = jnp.sum(whole.weights[..., None] * skin[patch.faces[whole.face]], axis=1)
    least = jnp.linalg.norm(feet - x, axis=1)

    def within(candidates):
        """Share of the vertices whose nearest skin is a candidate, to a millimetre."""
        foot, _ = skin_foot(skin, normals, patch.faces, x, candidates)
        return float(jnp.mean(jnp.linalg.norm(foot - x, axis=1) < least + 1e-3))

    # The rest is nearest to another limb, from which it must not be pushed.
    assert within(faces_near(patch, skin, x)) > 0.85
    # The control: skin that was near at rest.
    assert within(faces_at_rest(patch)) < 0.7


def test_a_leg_that_comes_forward_carries_the_front_of_a_skirt(body, rest, stride):
    wearable, patch = fitted(body, rest, "dress")
    rows = np.asarray(patch.skirt.rows)
    # A skirt that didn't follow the legs: it hangs from the hips alone.
    hips = jnp.zeros_like(wearable.skin).at[:, body.joint("Hips")].set(1.0)
    stiff = skin_wearable(dataclasses.replace(wearable, skin=hips), *stride)
    before = np.asarray(skin_height(patch, stiff, *stride)[0])[rows]
    assert np.mean(before < 0) > 0.02
    moved = push_out(patch, stiff, *stride)
    after = np.asarray(skin_height(patch, moved, *stride)[0])[rows]
    assert np.mean(after < 0) < 0.002 < np.mean(before < 0)
    # The front stays the front: no vertex is pushed through to the other side.
    gap = np.asarray(moved - stiff)[rows]
    outward = np.asarray(patch.skirt.outward)
    forward = np.abs(outward[:, 2]) > 0.8
    far = forward & (np.linalg.norm(gap, axis=1) > 0.03)
    turned = np.asarray(stride[0])[body.joint("Hips")]
    side = np.sum(gap * (outward @ turned.T), axis=1)
    assert far.sum() > 20 and np.mean(side[far] > 0) > 0.95


def test_gradients_through_a_skirt_in_a_stride_are_finite(body, rest, stride):
    wearable, patch = fitted(body, rest, "dress")
    x = skin_wearable(wearable, *stride)

    def height(points, rotations):
        return jnp.mean(push_out(patch, points, rotations, stride[1]) ** 2)

    for g in jax.grad(height, argnums=(0, 1))(x, stride[0]):
        assert np.isfinite(np.asarray(g)).all() and np.abs(np.asarray(g)).max() > 0


@pytest.mark.parametrize("name", [pytest.param("bottom", marks=pytest.mark.slow), "dress"])
def test_frame_by_frame_is_all_at_once(body, rest, name):
    """The way CPUs take against one batch; gradients where they compile quickly."""
    world, shift = clip_transforms(body, rest, load_motion("walk", fps=30.0))
    world, shift = jnp.asarray(world[:3]), jnp.asarray(shift[:3])
    wearable, patch = fitted(body, rest, name)
    x = jax.vmap(lambda r, t: skin_wearable(wearable, r, t))(world, shift)

    def batched(points, rotations):
        return jax.vmap(lambda p, r, t: push_out(patch, p, r, t))(points, rotations, shift)

    def looped(points, rotations):
        return each_frame(functools.partial(push_out, patch), points, rotations, shift)

    found = []
    for way in (batched, looped):
        result = [jax.jit(way)(x, world)]
        if name == "bottom":
            grad = jax.grad(lambda p, r, way=way: jnp.mean(way(p, r) ** 2), argnums=(0, 1))
            result += jax.jit(grad)(x, world)
        found.append(result)
    for a, b in zip(*found, strict=True):
        np.testing.assert_allclose(np.asarray(a), np.asarray(b), atol=1e-6)


def test_a_gradient_keeps_no_frame_in_memory(body, rest):
    """Ten frames more cost what goes in and out of them, not what lies between."""
    wearable, patch = fitted(body, rest, "bottom")
    joints = wearable.skin.shape[1]

    def memory(frames: int) -> int:
        shapes = ((frames, *wearable.rest.shape), (frames, joints, 3, 3), (frames, joints, 3))
        arrays = [jax.ShapeDtypeStruct(s, jnp.float32) for s in shapes]

        def total(*values):
            return jnp.sum(each_frame(functools.partial(push_out, patch), *values))

        program = jax.jit(jax.grad(total, argnums=(0, 1, 2))).lower(*arrays).compile()
        return program.memory_analysis().temp_size_in_bytes

    room = wearable.rest.size * 4
    assert (memory(12) - memory(2)) / 10 < 8 * room


def test_long_edges_stand_off_farther(body, rest):
    g = template("bottom")
    wearable = unbound_wearable(body, rest, g)
    fine = make_patch(body, rest, wearable, g.mesh).least
    far = np.asarray(g.mesh.vertices)
    # The same vertices with a few triangles over 10 cm.
    distance = np.linalg.norm(far - far[0], axis=1)
    near_by = np.argsort(np.abs(distance - 0.1))[:2]
    wide = g.mesh.replace(
        faces=jnp.concatenate([g.mesh.faces, jnp.asarray([[0, *near_by]], jnp.int32)])
    )
    coarse = make_patch(body, rest, wearable, wide).least
    assert float(coarse[0]) == pytest.approx(0.02, abs=1e-4)
    assert float(fine[0]) < 0.008
    changed = np.flatnonzero(np.asarray(coarse != fine))
    assert set(changed) <= {0, *near_by.tolist()}


def test_tucking_in_leaves_room_between_least_and_most(body, rest):
    pairs = [fitted(body, rest, t) for t in ("top", "bottom")]
    coarse = [dataclasses.replace(p, least=p.least + 0.01) for _, p in pairs]
    top, bottom = tuck_in(coarse, [w for w, _ in pairs])
    assert bool((bottom.most >= bottom.least).all())
    away = KDTree(np.asarray(pairs[1][0].rest)).query(np.asarray(pairs[0][0].rest))[0]
    assert float(top.least[away < 0.04].min()) > float(bottom.least.max())


def test_a_top_far_from_trousers_is_as_it_is_without_them(body, rest):
    pairs = [fitted(body, rest, t) for t in ("top", "bottom")]
    alone = pairs[0][1].least
    (top, _) = tuck_in([p for _, p in pairs], [w for w, _ in pairs])
    away = KDTree(np.asarray(pairs[1][0].rest)).query(np.asarray(pairs[0][0].rest))[0]
    assert (away > 0.08).mean() > 0.5
    np.testing.assert_array_equal(top.least[away > 0.08], alone[away > 0.08])
    # The control: over the trousers it keeps farther off.
    assert float((top.least - alone)[away < 0.03].min()) > 0.003
    # Nor is there a step between.
    edges = mesh_edges(np.asarray(template("top").mesh.faces)).vertices
    more = np.asarray(top.least - alone)
    assert np.abs(more[edges[:, 0]] - more[edges[:, 1]]).max() < 0.006


@pytest.mark.parametrize(
    ("depth", "share"), [(-0.002, 1.0), (0.02, 1.0), (0.035, 0.5), (0.041, 0.0), (0.2, 0.0)]
)
def test_what_lies_deep_is_on_another_limbs_far_side_and_stays(depth, share):
    """The lift fades out in the last centimetre before four."""
    points = jnp.asarray([[0.3, -depth, 0.1]], jnp.float32)
    feet = jnp.asarray([[0.3, 0.0, 0.1]]), jnp.asarray([[0.0, 1.0, 0.0]])
    height, lift = _off_skin(points, feet, jnp.asarray([0.005]), jnp.asarray([jnp.inf]))
    assert float(height[0]) == pytest.approx(-depth, abs=1e-6)
    assert float(lift[0, 1]) == pytest.approx(share * (depth + 0.005), abs=1e-5)
    assert not lift[0, ::2].any()
