"""The last push-out: what is inside comes out on its own side, the rest stays."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import KDTree

from physxnet_jax.dressing.postprocess._collisions import (
    _off_skin,
    _posed,
    faces_at_rest,
    faces_near,
    make_collider,
    resolve_collisions,
    set_layer_clearance,
    skin_clearance,
)
from physxnet_jax.dressing.postprocess._skirt import closest_skin_point
from physxnet_jax.garment import make_skinned, skin_garment, template
from physxnet_jax.geometry import TriMesh, closest_points, map_frames, mesh_edges
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
    bound = make_skinned(g, rest)
    return bound, make_collider(body, rest, bound, g.mesh)


@pytest.mark.release
def test_collisions_lift_only_vertices_inside_the_body(body, rest, balance):
    bound, patch = fitted(body, rest, "bottom")
    x = skin_garment(bound, *balance)
    height = skin_clearance(patch, x, *balance)[0]
    clear = np.asarray(height > patch.least + 1e-4)
    assert clear.any() and not clear.all()
    same = resolve_collisions(patch, x, *balance)
    np.testing.assert_array_equal(np.asarray(same)[clear], np.asarray(x)[clear])
    # With a wanted height of a metre, the way is the skin's normal.
    tall = dataclasses.replace(patch, least=jnp.ones_like(patch.least))
    way = skin_clearance(tall, x, *balance)[1]
    sunk = x - (height + 0.01)[:, None] * way / jnp.linalg.norm(way, axis=1, keepdims=True)
    assert float(jnp.mean(skin_clearance(patch, sunk, *balance)[0])) < -0.005
    lifted = resolve_collisions(patch, sunk, *balance)
    after = np.asarray(skin_clearance(patch, lifted, *balance)[0])
    assert np.mean(after > -1e-3) > 0.97


@pytest.mark.release
@pytest.mark.parametrize("name", ["top", "bottom"])
def test_nearest_skin_is_found_on_the_posed_body(body, rest, name):
    """A knee drawn up, the back bent, an arm laid on."""
    bound, patch = fitted(body, rest, name)
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
    x = skin_garment(bound, r, t)
    x = x + 0.03 * jax.random.normal(jax.random.key(0), x.shape)
    skin, normals = _posed(patch, r, t)
    whole = closest_points(TriMesh(skin, patch.faces), x)
    feet = jnp.sum(whole.weights[..., None] * skin[patch.faces[whole.face]], axis=1)
    least = jnp.linalg.norm(feet - x, axis=1)

    def within(candidates):
        """Share of the vertices whose nearest skin is a candidate, to a millimetre."""
        foot, _ = closest_skin_point(skin, normals, patch.faces, x, candidates)
        return float(jnp.mean(jnp.linalg.norm(foot - x, axis=1) < least + 1e-3))

    # The rest is nearest to another limb, from which it must not be pushed.
    assert within(faces_near(patch, skin, x)) > 0.85
    # The control: skin that was near at rest.
    assert within(faces_at_rest(patch)) < 0.7


@pytest.mark.release
def test_forward_leg_pushes_the_front_of_a_skirt(body, rest, stride):
    bound, patch = fitted(body, rest, "dress")
    rows = np.asarray(patch.skirt.rows)
    # A skirt that didn't follow the legs: it hangs from the hips alone.
    hips = jnp.zeros_like(bound.skin).at[:, body.joint("Hips")].set(1.0)
    stiff = skin_garment(dataclasses.replace(bound, skin=hips), *stride)
    before = np.asarray(skin_clearance(patch, stiff, *stride)[0])[rows]
    assert np.mean(before < 0) > 0.02
    moved = resolve_collisions(patch, stiff, *stride)
    after = np.asarray(skin_clearance(patch, moved, *stride)[0])[rows]
    assert np.mean(after < 0) < 0.002 < np.mean(before < 0)
    # The front stays the front: no vertex is pushed through to the other side.
    gap = np.asarray(moved - stiff)[rows]
    outward = np.asarray(patch.skirt.outward)
    forward = np.abs(outward[:, 2]) > 0.8
    far = forward & (np.linalg.norm(gap, axis=1) > 0.03)
    turned = np.asarray(stride[0])[body.joint("Hips")]
    side = np.sum(gap * (outward @ turned.T), axis=1)
    assert far.sum() > 20 and np.mean(side[far] > 0) > 0.95


@pytest.mark.release
def test_skirt_collision_gradients_in_a_stride_are_finite(body, rest, stride):
    bound, patch = fitted(body, rest, "dress")
    x = skin_garment(bound, *stride)

    def height(points, rotations):
        return jnp.mean(resolve_collisions(patch, points, rotations, stride[1]) ** 2)

    for g in jax.grad(height, argnums=(0, 1))(x, stride[0]):
        assert np.isfinite(np.asarray(g)).all() and np.abs(np.asarray(g)).max() > 0


@pytest.mark.release
@pytest.mark.parametrize("name", [pytest.param("bottom", marks=pytest.mark.nightly), "dress"])
def test_map_frames_matches_a_batch(body, rest, name):
    """The way CPUs take against one batch; gradients where they compile quickly."""
    world, shift = clip_transforms(body, rest, load_motion("walk", fps=30.0))
    world, shift = jnp.asarray(world[:3]), jnp.asarray(shift[:3])
    bound, patch = fitted(body, rest, name)
    x = jax.vmap(lambda r, t: skin_garment(bound, r, t))(world, shift)

    def batched(points, rotations):
        return jax.vmap(lambda p, r, t: resolve_collisions(patch, p, r, t))(
            points, rotations, shift
        )

    def looped(points, rotations):
        return map_frames(functools.partial(resolve_collisions, patch), points, rotations, shift)

    found = []
    for way in (batched, looped):
        result = [jax.jit(way)(x, world)]
        if name == "bottom":
            grad = jax.grad(lambda p, r, way=way: jnp.mean(way(p, r) ** 2), argnums=(0, 1))
            result += jax.jit(grad)(x, world)
        found.append(result)
    for a, b in zip(*found, strict=True):
        np.testing.assert_allclose(np.asarray(a), np.asarray(b), atol=1e-6)


@pytest.mark.release
def test_collision_gradients_store_no_intermediates_per_frame(body, rest):
    """Ten frames more cost what goes in and out of them, not what lies between."""
    bound, patch = fitted(body, rest, "bottom")
    joints = bound.skin.shape[1]

    def memory(frames: int) -> int:
        shapes = ((frames, *bound.rest.shape), (frames, joints, 3, 3), (frames, joints, 3))
        arrays = [jax.ShapeDtypeStruct(s, jnp.float32) for s in shapes]

        def total(*values):
            return jnp.sum(map_frames(functools.partial(resolve_collisions, patch), *values))

        program = jax.jit(jax.grad(total, argnums=(0, 1, 2))).lower(*arrays).compile()
        return program.memory_analysis().temp_size_in_bytes

    room = bound.rest.size * 4
    assert (memory(12) - memory(2)) / 10 < 8 * room


def test_long_edges_have_a_larger_clearance(body, rest):
    g = template("bottom")
    bound = make_skinned(g, rest)
    fine = make_collider(body, rest, bound, g.mesh).least
    far = np.asarray(g.mesh.vertices)
    # The same vertices with a few triangles over 10 cm.
    distance = np.linalg.norm(far - far[0], axis=1)
    near_by = np.argsort(np.abs(distance - 0.1))[:2]
    wide = g.mesh.replace(
        faces=jnp.concatenate([g.mesh.faces, jnp.asarray([[0, *near_by]], jnp.int32)])
    )
    coarse = make_collider(body, rest, bound, wide).least
    assert float(coarse[0]) == pytest.approx(0.02, abs=1e-4)
    assert float(fine[0]) < 0.008
    changed = np.flatnonzero(np.asarray(coarse != fine))
    assert set(changed) <= {0, *near_by.tolist()}


def test_layer_clearance_keeps_its_maximum_above_its_minimum(body, rest):
    pairs = [fitted(body, rest, t) for t in ("top", "bottom")]
    coarse = [dataclasses.replace(p, least=p.least + 0.01) for _, p in pairs]
    top, bottom = set_layer_clearance(coarse, [w for w, _ in pairs])
    assert bool((bottom.most >= bottom.least).all())
    away = KDTree(np.asarray(pairs[1][0].rest)).query(np.asarray(pairs[0][0].rest))[0]
    assert float(top.least[away < 0.04].min()) > float(bottom.least.max())


def test_clearance_of_a_top_is_unchanged_far_from_trousers(body, rest):
    pairs = [fitted(body, rest, t) for t in ("top", "bottom")]
    alone = pairs[0][1].least
    (top, _) = set_layer_clearance([p for _, p in pairs], [w for w, _ in pairs])
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
def test_collision_lift_fades_out_for_deep_vertices(depth, share):
    """The lift fades out in the last centimetre before four."""
    points = jnp.asarray([[0.3, -depth, 0.1]], jnp.float32)
    feet = jnp.asarray([[0.3, 0.0, 0.1]]), jnp.asarray([[0.0, 1.0, 0.0]])
    height, lift = _off_skin(points, feet, jnp.asarray([0.005]), jnp.asarray([jnp.inf]))
    assert float(height[0]) == pytest.approx(-depth, abs=1e-6)
    assert float(lift[0, 1]) == pytest.approx(share * (depth + 0.005), abs=1e-5)
    assert not lift[0, ::2].any()
