"""Watertight rays: nothing slips through edges or vertices, and trimesh agrees."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from physxnet_jax.geometry import cast_rays, cast_rays_within, make_mesh


@pytest.fixture(scope="module")
def sphere():
    s = trimesh.creation.icosphere(subdivisions=3)
    return make_mesh(s.vertices, s.faces)


def test_rays_through_every_edge_and_vertex_hit(sphere):
    v, f = np.asarray(sphere.vertices), np.asarray(sphere.faces)
    targets = np.concatenate([v, v[f[:, [0, 1]]].mean(axis=1), v[f[:, [1, 2]]].mean(axis=1)])
    hits = cast_rays(sphere, jnp.zeros_like(jnp.asarray(targets)), jnp.asarray(targets))
    assert bool(hits.valid.all())
    length = np.linalg.norm(targets, axis=1)
    np.testing.assert_allclose(np.asarray(hits.distance), length, rtol=1e-5)


def test_random_rays_from_inside_never_leak(sphere):
    rng = np.random.default_rng(0)
    origins = rng.uniform(-0.5, 0.5, (20_000, 3)).astype(np.float32)
    directions = rng.normal(size=origins.shape).astype(np.float32)
    # Axis-parallel rays make two of the shears zero.
    directions[:300] = np.repeat(np.concatenate([np.eye(3), -np.eye(3)]), 50, axis=0)
    hits = cast_rays(sphere, jnp.asarray(origins), jnp.asarray(directions))
    assert bool(hits.valid.all())


@pytest.mark.release
def test_hits_match_embree_on_100_000_random_rays(sphere):
    """The two differ only where a ray grazes an edge: by rounding."""
    mesh = trimesh.Trimesh(np.asarray(sphere.vertices), np.asarray(sphere.faces), process=False)
    rng = np.random.default_rng(1)
    origins = rng.uniform(-2, 2, (100_000, 3)).astype(np.float32)
    directions = rng.normal(size=origins.shape).astype(np.float32)
    ours = cast_rays(sphere, jnp.asarray(origins), jnp.asarray(directions))
    theirs = mesh.ray.intersects_first(origins, directions)
    valid = np.asarray(ours.valid)
    differ = np.flatnonzero((theirs >= 0) != valid)
    both = np.flatnonzero((theirs >= 0) & valid)
    other = both[theirs[both] != np.asarray(ours.face)[both]]
    # Where the verdict or the face differs, the ray passes an edge within rounding.
    assert len(differ) + len(other) <= 20
    weights = np.asarray(ours.weights)
    assert (weights[other].min(axis=1) < 1e-3).all()
    for ray in differ:
        unit = directions[ray] / np.linalg.norm(directions[ray])
        v, f = np.asarray(sphere.vertices), np.asarray(sphere.faces)
        a, b = v[f[:, [0, 1, 2]].ravel()], v[f[:, [1, 2, 0]].ravel()]
        normal = np.cross(b - a, unit)
        gap = np.abs(np.einsum("ij,ij->i", a - origins[ray], normal))
        assert (gap / np.linalg.norm(normal, axis=1)).min() < 1e-4


def test_bidirectional_rays_take_the_nearer_hit():
    mesh = make_mesh(
        [[-1, -1, 1], [1, -1, 1], [0, 1, 1], [-1, -1, -3], [1, -1, -3], [0, 1, -3]],
        [[0, 1, 2], [3, 4, 5]],
    )
    origin, back = jnp.zeros((1, 3)), jnp.array([[0.0, 0.0, -1.0]])
    one_way = cast_rays(mesh, origin, back)
    assert float(one_way.distance[0]) == pytest.approx(3.0)
    two_way = cast_rays(mesh, origin, back, both=True)
    assert float(two_way.distance[0]) == pytest.approx(-1.0)
    assert int(two_way.face[0]) == 0


def test_degenerate_triangles_and_zero_directions_are_finite_misses():
    mesh = make_mesh(
        [[0, 0, 1], [1, 0, 1], [2, 0, 1], [0, 0, 1]], [[0, 1, 2], [0, 3, 1], [0, 0, 0]]
    )
    rays = jnp.array([[0.0, 0.0, 1.0], [0.0, 0.0, 0.0]])
    hits = cast_rays(mesh, jnp.zeros((2, 3)) + jnp.array([[0.5, 0.0, 0.0]]), rays)
    assert not bool(hits.valid.any())
    assert bool(jnp.isfinite(hits.weights).all())


def test_max_distance_does_not_remove_nearer_hits(sphere):
    origin, ray = jnp.zeros((1, 3)), jnp.array([[1.0, 0.2, 0.1]])
    assert not bool(cast_rays(sphere, origin, ray, max_distance=0.5).valid[0])
    assert bool(cast_rays(sphere, origin, ray, max_distance=1.1).valid[0])


def test_hit_distances_are_invariant_to_rigid_motion(sphere):
    rng = np.random.default_rng(2)
    origins = rng.uniform(-0.3, 0.3, (200, 3)).astype(np.float32)
    directions = rng.normal(size=origins.shape).astype(np.float32)
    turn = trimesh.transformations.random_rotation_matrix(rng.random(3))[:3, :3].astype(np.float32)
    shift = np.array([[0.4, -1.0, 2.0]], np.float32)
    moved = sphere.replace(vertices=jnp.asarray(np.asarray(sphere.vertices) @ turn.T + shift))
    a = cast_rays(sphere, jnp.asarray(origins), jnp.asarray(directions))
    b = cast_rays(moved, jnp.asarray(origins @ turn.T + shift), jnp.asarray(directions @ turn.T))
    np.testing.assert_allclose(np.asarray(a.distance), np.asarray(b.distance), atol=1e-5)


def test_gradient_of_the_distance_is_finite_and_correct(sphere):
    def height(z):
        origin = jnp.stack([jnp.float32(0.05), jnp.float32(0.02), z])[None]
        return cast_rays(sphere, origin, jnp.array([[0.0, 0.0, 1.0]])).distance[0]

    assert float(jax.grad(height)(jnp.float32(0.1))) == pytest.approx(-1.0, abs=1e-4)


@pytest.mark.release
@pytest.mark.parametrize("reach", [0.02, 0.2, 3.0])
def test_rays_of_limited_reach_find_what_all_rays_find(reach):
    """Block by block among the triangles in reach, of a body's size and finer."""
    rng = np.random.default_rng(5)
    sphere = trimesh.creation.icosphere(subdivisions=3, radius=0.3)
    mesh = make_mesh(np.asarray(sphere.vertices), np.asarray(sphere.faces))
    origins = rng.normal(size=(700, 3)).astype(np.float32) * 0.3
    directions = rng.normal(size=(700, 3)).astype(np.float32)
    directions[::50] = 0.0
    limit = np.full(700, reach, np.float32)
    found = cast_rays_within(mesh, origins, directions, limit)
    every = cast_rays(
        mesh, jnp.asarray(origins), jnp.asarray(directions), both=True, max_distance=reach
    )
    np.testing.assert_array_equal(found.valid, every.valid)
    hit = np.asarray(found.valid)
    assert hit.any() and not hit[::50].any()
    np.testing.assert_allclose(found.distance[hit], every.distance[hit], atol=1e-6)
    same = np.asarray(found.face)[hit] == np.asarray(every.face)[hit]
    assert same.mean() > 0.99
    np.testing.assert_allclose(found.weights[hit][same], every.weights[hit][same], atol=1e-4)
