"""Laying the body onto other people: of another topology, size, pose and heading."""

import fast_simplification
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from physxnet_jax.body import (
    _register,
    clothed_vertices,
    linear_blend_skinning,
    register_body,
    t_pose,
)
from physxnet_jax.body._scan import Scan
from physxnet_jax.errors import MeshError
from physxnet_jax.geometry import closest_points, make_mesh


@pytest.fixture(scope="module")
def stranger(body):
    """A tall man in T-pose, turned by 130 degrees, of 9,000 triangles."""
    shape = body.shape(gender=1.0, height_up=0.7, muscle_up=0.5)
    rest = body.rest_vertices(shape)
    world, shift = body.transforms(rest, t_pose(body, shape), jnp.asarray([0.3, 1.0, -0.5]))
    n = 13380
    x = np.asarray(linear_blend_skinning(rest[:n], body.weights[:n], world, shift))
    turn = Rotation.from_euler("Y", 130, degrees=True).as_matrix().astype(np.float32)
    x = np.ascontiguousarray(x @ turn.T)
    vertices, faces = fast_simplification.simplify(
        np.array(x), np.array(body.rest_mesh().faces), target_count=9000
    )
    return rest, x, vertices.astype(np.float32), faces.astype(np.int32)


@pytest.mark.nightly
def test_registration_recovers_another_body_vertex_by_vertex(body, stranger):
    rest, x, vertices, faces = stranger
    seen = []
    found = register_body(vertices, faces, progress=lambda *at: seen.append(at))
    clothed = clothed_vertices(body)
    assert found.sure[clothed].mean() > 0.99 and found.distance[clothed].mean() < 0.008
    error = np.linalg.norm(found.posed - x, axis=1)[clothed]
    assert np.sqrt((error**2).mean()) < 0.015
    # Of the same proportions: every limb as long as his.
    ours, his = (np.asarray(body.joint_positions(jnp.asarray(r))[0]) for r in (found.rest, rest))
    for name, end in (("Arm", "ForeArm"), ("UpLeg", "Leg"), ("Leg", "Foot")):
        for side in ("Left", "Right"):
            a, b = body.joint(side + name), body.joint(side + end)
            long = [np.linalg.norm(p[b] - p[a]) for p in (ours, his)]
            assert abs(long[0] - long[1]) < 0.025
    # It is carried wherever the mesh goes; places on faces are barycentric.
    np.testing.assert_allclose(found.weights.sum(axis=1), 1.0, atol=1e-5)
    assert found.weights.min() > -1e-6
    twice = found.carried(np.stack([vertices, 2 * vertices + 1]), faces)
    np.testing.assert_allclose(twice[0], found.posed, atol=1e-6)
    np.testing.assert_allclose(twice[1], 2 * found.posed + 1, atol=1e-5)
    assert seen[-1][1] == seen[-1][2] and [t[1] for t in seen] == list(range(1, len(seen) + 1))


@pytest.mark.release
@pytest.mark.parametrize("drawn", [True, False])
def test_surface_reaches_what_protrudes(body, drawn, monkeypatch):
    rest = body.rest_vertices(body.default_shape())
    world, shift = body.transforms(rest, body.a_pose(), jnp.zeros(3))
    n = 13380
    x0 = np.asarray(linear_blend_skinning(rest[:n], body.weights[:n], world, shift))
    x = x0.astype(np.float64)
    # The chest of a stylised character.
    for side in (-1, 1):
        away = np.linalg.norm(x0 - np.asarray(x0[_chest(x0, side)]) + [0, 0, 0.08], axis=1)
        x += np.maximum(1.0 - (away / 0.13) ** 2, 0.0)[:, None] * [side * 0.02, -0.03, 0.11]
    faces = np.asarray(body.rest_mesh().faces)
    if not drawn:
        monkeypatch.setattr(_register, "_drawn", lambda x, n, _: (np.zeros(len(x)), 0.0 * x))
    parts = (np.asarray(v) for v in (rest, world, shift))
    found = _register._project_to_surface(body, Scan(x, faces), *parts)
    met = closest_points(make_mesh(found.posed, faces), jnp.asarray(x, jnp.float32))
    apart = np.sqrt(np.asarray(met.squared_distance))[clothed_vertices(body)]
    assert (apart.max() < 0.025) == drawn, apart.max()


def _chest(x, side):
    """The foremost vertex of a breast."""
    height = (x[:, 1] - x[:, 1].min()) / np.ptp(x[:, 1])
    rows = np.flatnonzero((height > 0.7) & (height < 0.76) & (side * x[:, 0] > 0.04))
    rows = rows[np.abs(x[rows, 0]) < 0.13]
    return rows[x[rows, 2].argmax()]


@pytest.mark.nightly
def test_meshes_that_are_not_bodies_are_refused():
    ball = trimesh.creation.icosphere(4, 0.8)
    vertices = np.asarray(ball.vertices, np.float32)
    with pytest.raises(MeshError, match="can't be registered to"):
        register_body(vertices, np.asarray(ball.faces, np.int32))
    with pytest.raises(MeshError, match="no surface"):
        register_body(np.zeros((3, 3), np.float32), np.array([[0, 1, 2]], np.int32))


def test_body_with_rest_has_these_vertices_for_every_shape(body, rest):
    moved = rest * jnp.float32(1.1)
    other = body.with_rest(moved)
    for shape in (body.default_shape(), body.shape(gender=1.0, weight_up=0.5)):
        np.testing.assert_allclose(other.rest_vertices(shape), moved, atol=1e-6)
