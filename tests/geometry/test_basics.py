"""Rotations, normals, topology, intersection: closed forms and singular points."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings, strategies as st
from scipy.spatial.transform import Rotation

from physxnet_jax.errors import MeshError
from physxnet_jax.geometry import (
    boundary_loops,
    connected_components,
    greedy_coloring,
    hinges,
    make_mesh,
    manifold_report,
    matrix_from_quaternion,
    mesh_edges,
    polar_rotation,
    quaternion_conjugate,
    quaternion_from_axis_angle,
    quaternion_multiply,
    safe_norm,
    safe_normalize,
    self_intersections,
    vertex_faces,
    vertex_normals,
)

_ANGLES = st.tuples(*[st.floats(-3, 3, width=32)] * 3)


@settings(max_examples=40, deadline=None)
@given(_ANGLES, _ANGLES)
def test_rotations_match_scipy(a, b):
    qa, qb = (quaternion_from_axis_angle(jnp.asarray(x, jnp.float32)) for x in (a, b))
    ra, rb = Rotation.from_rotvec(a), Rotation.from_rotvec(b)
    both = matrix_from_quaternion(quaternion_multiply(qa, qb))
    np.testing.assert_allclose(np.asarray(both), (ra * rb).as_matrix(), atol=3e-6)
    back = quaternion_multiply(qa, quaternion_conjugate(qa))
    np.testing.assert_allclose(np.asarray(back), [1, 0, 0, 0], atol=1e-6)


def test_axis_angle_is_smooth_at_zero():
    jacobian = jax.jacobian(quaternion_from_axis_angle)(jnp.zeros(3))
    expected = np.vstack([np.zeros(3), 0.5 * np.eye(3)])
    np.testing.assert_allclose(np.asarray(jacobian), expected, atol=1e-7)


def test_polar_rotation_matches_products_of_matrices():
    """The iteration entry by entry is that with products of matrices."""
    rng = np.random.default_rng(0)
    x = np.eye(3) + 0.3 * rng.normal(size=(50, 3, 3))
    ours = np.asarray(polar_rotation(jnp.asarray(x, jnp.float32)))
    for _ in range(6):
        x = 1.5 * x - 0.5 * x @ np.swapaxes(x, 1, 2) @ x
    np.testing.assert_allclose(ours, x, atol=2e-5)


def test_polar_rotation_is_the_nearest_one_and_finite_when_singular():
    rng = np.random.default_rng(0)
    blends = 0.6 * Rotation.random(20, rng).as_matrix()
    near = Rotation.from_rotvec(rng.normal(0, 0.4, (20, 3)))
    blends = 0.6 * near.as_matrix() + 0.4 * np.eye(3)
    ours = np.asarray(polar_rotation(jnp.asarray(blends.astype(np.float32))))
    u, _, vt = np.linalg.svd(blends)
    np.testing.assert_allclose(ours, u @ vt, atol=1e-5)
    half_turn = jnp.diag(jnp.array([0.0, 0.0, 1.0]))
    slope = jax.grad(lambda m: polar_rotation(m).sum())(half_turn)
    assert bool(jnp.isfinite(slope).all())


def test_safe_norms_have_finite_gradients_at_zero_and_are_exact_elsewhere():
    for f in (lambda v: safe_normalize(v).sum(), safe_norm):
        assert bool(jnp.isfinite(jax.grad(f)(jnp.zeros(3))).all())
    tiny = jnp.array([3e-9, 4e-9, 0.0])
    np.testing.assert_allclose(np.asarray(safe_normalize(tiny)), [0.6, 0.8, 0], atol=1e-5)
    assert float(safe_norm(jnp.array([3.0, 4.0, 0.0]))) == pytest.approx(5.0)


def test_sphere_normals_point_outwards():
    s = trimesh.creation.icosphere(subdivisions=3)
    n = vertex_normals(jnp.asarray(s.vertices, jnp.float32), jnp.asarray(s.faces, jnp.int32))
    np.testing.assert_allclose(np.asarray(n), s.vertices, atol=1e-2)


def test_normals_of_slivers_are_finite_with_gradient():
    v = jnp.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 0, 0]])
    f = jnp.array([[0, 1, 2], [0, 3, 1]])
    slope = jax.grad(lambda x: vertex_normals(x, f).sum())(v)
    assert bool(jnp.isfinite(slope).all())


def test_topology_of_an_open_cylinder_is_correct():
    n = 8
    lower = np.arange(n)
    faces = []
    for k in range(n):
        a, b = lower[k], lower[(k + 1) % n]
        faces += [[a, b, b + n], [a, b + n, a + n]]
    f = np.asarray(faces)
    assert sorted(len(x) for x in boundary_loops(f)) == [n, n]
    edges = mesh_edges(f)
    assert len(edges.vertices) == 4 * n and (edges.count == 1).sum() == 2 * n
    assert len(hinges(f)) == 2 * n
    assert len(set(connected_components(f, 2 * n))) == 1
    table = vertex_faces(f, 2 * n)
    assert all(v in f[i] for v in range(2 * n) for i in table[v])
    report = manifold_report(f)
    assert report["non_manifold_edges"] == 0 and report["inconsistent_edges"] == 0
    assert manifold_report(np.concatenate([f, f[:1]]))["duplicate_faces"] == 1


def test_color_groups_share_no_vertex_and_cover_all_edges():
    s = trimesh.creation.icosphere(subdivisions=2)
    edges = mesh_edges(s.faces).vertices
    groups = greedy_coloring(edges, len(s.vertices))
    assert sorted(np.concatenate(groups)) == list(range(len(edges)))
    for g in groups:
        used = edges[g].ravel()
        assert len(np.unique(used)) == len(used)


def test_self_intersections_are_detected_without_false_positives():
    flat = [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
    through = [[0.2, 0.2, -1], [0.2, 0.2, 1], [0.3, 0.9, 1]]
    beside = [[5.2, 0.2, -1], [5.2, 0.2, 1], [5.3, 0.9, 1]]
    faces = np.array([[0, 1, 2], [3, 4, 5]])
    assert len(self_intersections(np.asarray(flat + through), faces)) > 0
    assert len(self_intersections(np.asarray(flat + beside), faces)) == 0


@pytest.mark.parametrize(
    ("vertices", "faces", "says"),
    [
        ([[0, 0, 0]], np.zeros((0, 3), int), "at least one triangle"),
        ([[0, 0, 0]], [[0, 0, 1]], "1 vertices"),
        ([[0, 0, float("nan")]], [[0, 0, 0]], "not finite"),
        ([[0, 0]], [[0, 0, 0]], "[vertices, 3]"),
    ],
)
def test_invalid_meshes_are_refused_with_a_message(vertices, faces, says):
    with pytest.raises(MeshError, match=says.replace("[", r"\[")):
        make_mesh(vertices, faces)


@pytest.mark.parametrize(("corner", "says"), [(-1, "uv -1, but there are 3"), (3, "uv 3, but")])
def test_texture_indices_out_of_range_are_refused(corner, says):
    with pytest.raises(MeshError, match=says):
        make_mesh(np.eye(3), [[0, 1, 2]], np.zeros((3, 2)), [[0, 1, corner]])


def test_known_jax_miscomputation_is_absent():
    """jax-ml/jax#39103: wrong rows in jit(vmap(matvec, reduce)) on CPU."""
    rows = np.random.default_rng(0).normal(size=(36_000, 3)).astype(np.float32)
    turn = Rotation.from_rotvec([0.3, -0.5, 0.8]).as_matrix().astype(np.float32)
    ours = jax.jit(jax.vmap(lambda r: jnp.sum((turn @ r) ** 2)))(rows)
    np.testing.assert_allclose(np.asarray(ours), (rows**2).sum(axis=1), rtol=1e-4)


def test_box_vertex_normals_do_not_depend_on_the_triangulation():
    """One or two triangles of a side meet in a corner: angles count, not triangles."""
    box = trimesh.creation.box((1, 1, 1))
    n = vertex_normals(jnp.asarray(box.vertices, jnp.float32), jnp.asarray(box.faces, jnp.int32))
    np.testing.assert_allclose(np.asarray(n), np.sign(box.vertices) / np.sqrt(3), atol=1e-5)


def test_longest_boundary_loop_comes_first():
    faces = np.array([[0, 1, 2], [3, 4, 5], [3, 5, 6]])
    assert [sorted(x.tolist()) for x in boundary_loops(faces)] == [[3, 4, 5, 6], [0, 1, 2]]
    # Two triangles that share a corner: one loop that passes it twice, wherever it begins.
    for bow in ([[0, 1, 2], [0, 3, 4]], [[2, 0, 1], [3, 4, 0]], [[1, 2, 0], [4, 0, 3]]):
        (loop,) = boundary_loops(np.array(bow))
        assert sorted(loop.tolist()) == [0, 0, 1, 2, 3, 4]


def test_normals_of_numpy_arrays_are_those_of_jax_arrays():
    rng = np.random.default_rng(3)
    vertices = rng.normal(size=(2, 9, 3)).astype(np.float32)
    # One triangle is a point, one a line; the last vertex has no triangle.
    faces = np.array([[0, 1, 2], [2, 1, 3], [4, 4, 4], [5, 6, 5], [3, 6, 7]], np.int32)
    found = vertex_normals(vertices, faces)
    assert isinstance(found, np.ndarray) and found.dtype == np.float32
    compiled = vertex_normals(jnp.asarray(vertices), jnp.asarray(faces))
    np.testing.assert_allclose(found, compiled, rtol=0, atol=1e-6)
    assert not found[:, 8].any()
    assert vertex_normals(vertices[0].astype(np.float64), faces).dtype == np.float64


def test_a_mesh_keeps_its_vertices_when_the_array_that_they_came_from_changes():
    # A device array may share the memory of a large array on a CPU, which depends on its address.
    arrays = [np.zeros((100_000 + 16 * k, 3), np.float32) for k in range(8)]
    meshes = [make_mesh(a, [[0, 1, 2]]) for a in arrays]
    for a in arrays:
        a[:] = 1.0
    assert not any(np.asarray(m.vertices).any() for m in meshes)
