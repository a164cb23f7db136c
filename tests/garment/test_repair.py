"""Mending meshes: what was broken is whole, what was whole stays, texture and all."""

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings, strategies as st

from physxnet_jax.errors import MeshError
from physxnet_jax.garment import clean, mesh_health, orient, subdivide, weld
from physxnet_jax.geometry import TriMesh, make_mesh


def sheet(n: int = 5) -> TriMesh:
    """A square metre of cloth with its own coordinates as texture."""
    u, v = np.meshgrid(np.linspace(0, 1, n), np.linspace(0, 1, n), indexing="ij")
    uv = np.stack([u.ravel(), v.ravel()], axis=1)
    x = np.column_stack([uv, np.zeros(n * n)])
    a = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    faces = np.concatenate([np.stack([a, a + n, a + n + 1], 1), np.stack([a, a + n + 1, a + 1], 1)])
    return make_mesh(x, faces, uv, faces)


def torn(mesh: TriMesh) -> TriMesh:
    """Every triangle with corners of its own, as many exporters write them."""
    faces = np.asarray(mesh.faces)
    alone = np.arange(faces.size).reshape(-1, 3)
    return make_mesh(np.asarray(mesh.vertices)[faces.ravel()], alone, mesh.uv, mesh.uv_faces)


def textured(mesh: TriMesh) -> np.ndarray:
    """Corner positions beside their texture coordinates, in any order of faces."""
    x = np.asarray(mesh.vertices)[np.asarray(mesh.faces)][..., :2]
    return np.abs(x - np.asarray(mesh.uv)[np.asarray(mesh.uv_faces)]).max()


def test_mesh_health_of_a_clean_sheet_is_exact():
    h = mesh_health(sheet())
    assert (h.vertices, h.faces, h.components) == (25, 32, 1)
    assert h.openings == pytest.approx((4.0,))
    assert h.median_edge == pytest.approx(0.25) and h.longest_edge == pytest.approx(0.25 * 2**0.5)
    assert h.uv and not any(
        (
            h.non_manifold_edges,
            h.duplicate_faces,
            h.degenerate_faces,
            h.inconsistent_edges,
            h.unused_vertices,
            h.coincident_vertices,
        )
    )


def test_mesh_health_counts_each_fault_separately():
    whole = sheet()
    x, faces = np.asarray(whole.vertices), np.asarray(whole.faces)
    fin = np.concatenate([x, [[0.5, 0.5, 0.3]]])
    edge = [*faces[5, :2], 25]
    cases = {
        "coincident_vertices": torn(whole),
        "duplicate_faces": make_mesh(x, np.concatenate([faces, faces[3:4]])),
        "degenerate_faces": make_mesh(x, np.concatenate([faces, faces[:1, [0, 0, 1]]])),
        "unused_vertices": make_mesh(fin, faces),
        "inconsistent_edges": make_mesh(
            x, np.where(np.arange(32)[:, None] == 7, faces[:, ::-1], faces)
        ),
        "non_manifold_edges": make_mesh(fin, np.concatenate([faces, [edge]])),
    }
    for name, mesh in cases.items():
        assert getattr(mesh_health(mesh), name) > 0, name
    # Of three faces at an edge two run in one sense whatever they do: that is no second fault.
    assert mesh_health(cases["non_manifold_edges"]).inconsistent_edges == 0


def test_many_coincident_vertices_are_counted_without_pairwise_comparison():
    x = np.concatenate([np.asarray(sheet().vertices), np.zeros((200_000, 3))])
    crowd = make_mesh(x, np.asarray(sheet().faces))
    assert mesh_health(crowd).coincident_vertices == 200_000
    # Nearly in one place is another matter.
    rng = np.random.default_rng(0)
    x[25:] = 1e-6 * rng.normal(size=(200_000, 3))
    with pytest.raises(MeshError, match="another unit"):
        weld(make_mesh(x, np.asarray(sheet().faces)))


def test_sheets_sharing_a_non_manifold_edge_are_oriented_independently():
    ball = trimesh.creation.icosphere(2, 1.0)
    body = make_mesh(ball.vertices, ball.faces)
    # Three leaves on one common edge, just outside the sphere; the second is inside out.
    a, b = np.array([0.0, 1.2, -0.3]), np.array([0.0, 1.2, 0.3])
    tips = np.array([[0.5, 1.2, 0.0], [-0.5, 1.2, 0.0], [0.1, 1.7, 0.0]])
    x = np.concatenate([[a, b], tips])
    faces = np.array([[0, 1, 2], [0, 1, 3], [0, 1, 4]])
    for senses in range(8):
        reoriented = np.array([f[::-1] if senses >> k & 1 else f for k, f in enumerate(faces)])
        out = np.asarray(orient(make_mesh(x, reoriented), body).faces)
        corner = x[out]
        normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        assert (np.einsum("fi,fi->f", normal, corner.mean(axis=1))[:2] > 0).all()


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 1000))
def test_torn_mesh_is_welded_and_keeps_its_texture(seed):
    whole = sheet()
    order = np.random.default_rng(seed).permutation(32)
    mixed = make_mesh(
        whole.vertices, np.asarray(whole.faces)[order], whole.uv, np.asarray(whole.uv_faces)[order]
    )
    back = weld(torn(mixed))
    h = mesh_health(back)
    assert (h.vertices, h.coincident_vertices, h.components) == (25, 0, 1)
    assert textured(back) < 1e-6
    # What is whole stays bit for bit.
    again = weld(back)
    np.testing.assert_array_equal(np.asarray(again.faces), np.asarray(back.faces))
    np.testing.assert_array_equal(np.asarray(again.vertices), np.asarray(back.vertices))


def test_welding_does_not_merge_separate_layers():
    two = np.concatenate(
        [np.asarray(sheet().vertices), np.asarray(sheet().vertices) + [0, 0, 2e-3]]
    )
    faces = np.concatenate([np.asarray(sheet().faces), np.asarray(sheet().faces) + 25])
    assert weld(make_mesh(two, faces)).vertices.shape[0] == 50
    assert weld(make_mesh(two, faces), 3e-3).vertices.shape[0] == 25


def test_cleaning_removes_invalid_faces_and_unused_vertices():
    whole = sheet()
    x = np.concatenate([np.asarray(whole.vertices), [[9.0, 9.0, 9.0]]])
    spoiled = np.concatenate([whole.faces, whole.faces[:2, [1, 2, 0]], whole.faces[:1, [0, 0, 1]]])
    chart = np.concatenate([whole.uv_faces, whole.uv_faces[:2, [1, 2, 0]], whole.uv_faces[:1]])
    back = clean(make_mesh(x, spoiled, whole.uv, chart))
    assert mesh_health(back) == mesh_health(whole) and textured(back) < 1e-6
    with pytest.raises(MeshError, match="no face"):
        clean(make_mesh(x, whole.faces[:1, [0, 0, 1]]))


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 1000), share=st.floats(0.0, 1.0))
def test_faces_are_oriented_outwards_from_any_winding(seed, share):
    rng = np.random.default_rng(seed)
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.1)
    body = make_mesh(ball.vertices, ball.faces)
    # Two caps that don't touch each other.
    keep = np.abs(ball.triangles_center[:, 1]) > 0.04
    faces = ball.faces[keep]
    flip = rng.uniform(size=len(faces)) < share
    mixed = np.where(flip[:, None], faces[:, ::-1], faces)
    cloth = make_mesh(1.1 * ball.vertices, mixed, ball.vertices[:, :2], mixed)
    out = orient(cloth, body)
    normal = np.cross(
        *(np.diff(np.asarray(out.vertices)[np.asarray(out.faces)], axis=1).swapaxes(0, 1))
    )
    assert (np.einsum("fi,fi->f", normal, ball.triangles_center[keep]) > 0).all()
    np.testing.assert_array_equal(np.asarray(out.uv_faces), np.asarray(out.faces))
    assert mesh_health(clean(out)).inconsistent_edges == 0


def test_subdivision_keeps_shape_and_texture_and_is_bounded():
    for longest in (0.6, 0.4, 0.2):
        fine, part_of = subdivide(sheet(3), longest)
        h = mesh_health(fine)
        assert h.longest_edge <= longest and h.components == 1
        assert h.openings == pytest.approx((4.0,)) and textured(fine) < 1e-6
        assert (h.coincident_vertices, h.inconsistent_edges, h.degenerate_faces) == (0, 0, 0)
        corners = np.asarray(fine.vertices)[np.asarray(fine.faces)]
        double = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        assert len(np.unique(np.sign(double[:, 2]))) == 1
        assert np.abs(double[:, 2]).sum() / 2 == pytest.approx(1.0)
        # Each is a part of the face that it says, and all of them together are that face.
        whole = np.asarray(sheet(3).vertices)[np.asarray(sheet(3).faces)]
        weights = np.linalg.solve(
            np.concatenate([whole[part_of, :, :2].swapaxes(1, 2), np.ones((h.faces, 1, 3))], 1),
            np.concatenate([corners.mean(axis=1)[:, :2], np.ones((h.faces, 1))], 1)[..., None],
        )
        assert (weights > 0).all()
        np.testing.assert_allclose(np.bincount(part_of, double[:, 2]), 0.25, rtol=1e-5)
    # One long edge splits no other.
    thin = make_mesh(
        np.array([[0, 0, 0], [1, 0, 0], [1, 0.1, 0], [0, 0.1, 0]]), np.array([[0, 1, 2], [0, 2, 3]])
    )
    assert mesh_health(subdivide(thin, 0.6)[0]).vertices == 7
    assert subdivide(sheet(3), 10.0)[0].faces.shape == sheet(3).faces.shape
    with pytest.raises(MeshError, match="Choose a longer one"):
        subdivide(sheet(3), 1e-4)
